"""`magic serve`: start a server that agents on any machine can join.

Examples:
  magic serve --data-dir /srv/magic
  magic serve --host 0.0.0.0 --insecure-bind        # plain text in a network you trust
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from magic_cli.options import parse
from magic_cli.output import console
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
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    from magic_server.server import Server, serve

    def ready(server: Server) -> None:
        target = server.address
        if command.progress == "json":
            sys.stdout.write(json.dumps({"ready": True, "target": target}) + "\n")
            sys.stdout.flush()
        else:
            console.print(f"magic-slam server at {target}, data in {command.data_dir}")
            console.print(f"Join with: magic agent DATASET --server {target}", markup=False)

    asyncio.run(serve(command, on_ready=ready))
    return 0
