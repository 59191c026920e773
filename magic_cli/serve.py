"""`magic serve`: start a server that agents on any machine can join.

Examples:
  magic serve --data-dir /srv/magic
  magic serve --config deploy/server.yaml           # every setting from a file
  magic serve --host 0.0.0.0 --tls.certificate server.pem --tls.key server.key \\
              --access.tokens-file tokens --metrics.port 9464
  magic serve --host 0.0.0.0 --insecure             # plaintext in a network you trust
"""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from magic_cli.options import parse
from magic_cli.output import console
from magic_core import logs, tracing
from magic_server.config import ListenConfig, ServerConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeCommand(ServerConfig):
    """Options of `magic serve`."""

    listen: Annotated[ListenConfig, tyro.conf.arg(name="")] = field(default_factory=ListenConfig)
    """Where the server listens."""
    progress: Literal["text", "json"] = "text"
    """`json` prints one line with the address on stdout once the server is ready."""


def main(arguments: list[str]) -> int:
    """Serve until told to stop; 0 after a clean end."""
    command = parse(ServeCommand, arguments, prog="magic serve", description=__doc__ or "")
    logs.configure(command.logs)
    tracing.configure(command.tracing, service="magic-server")
    from magic_server.server import Server, serve

    def ready(server: Server) -> None:
        target = server.address
        if command.progress == "json":
            ready = {"ready": True, "target": target, "metrics": server.metrics_address}
            sys.stdout.write(json.dumps(ready) + "\n")
            sys.stdout.flush()
        else:
            console.print(f"magic-slam server at {target}, data in {command.data_dir}")
            console.print(f"Join with: magic agent DATASET --server {target}", markup=False)
            if server.metrics_address is not None:
                console.print(f"Metrics at http://{server.metrics_address}/metrics", markup=False)

    asyncio.run(serve(command, on_ready=ready))
    return 0
