"""`magic serve`: start a server that agents on any machine can join.

Examples:
  magic serve --data-dir /srv/magic
  magic serve --config deploy/server.yaml           # every setting from a file
  magic serve --host 0.0.0.0 --tls.certificate server.pem --tls.key server.key \\
              --access.tokens-file tokens --metrics.port 9464
  magic serve --host 0.0.0.0 --insecure             # plaintext in a network you trust
  magic serve --viewer                              # and the map in the browser while it grows
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from magic_cli import lifeline, processes
from magic_cli.options import parse
from magic_cli.output import console
from magic_cli.systemd import notify
from magic_core import logs, tracing
from magic_core.errors import ConfigError
from magic_server.config import ListenConfig, ServerConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeCommand(ServerConfig):
    """Options of `magic serve`."""

    listen: Annotated[ListenConfig, tyro.conf.arg(name="")] = field(default_factory=ListenConfig)
    """Where the server listens."""
    viewer: bool = False
    """Serve the live view too, as a process of its own: `magic view` on this server."""
    viewer_port: int = 8080
    """Port of the live view; the next free one where it is taken."""
    viewer_splats: int = 1_000_000
    """Gaussians sent to the browser at most; without a GPU 100000 are drawn smoothly."""
    progress: Literal["text", "json"] = "text"
    """`json` prints one line with the address on stdout once the server is ready."""


def main(arguments: list[str]) -> int:
    """Serve until told to stop; 0 after a clean end."""
    command = parse(ServeCommand, arguments, prog="magic serve", description=__doc__ or "")
    asks_for_tokens = command.access.tokens_file or os.environ.get(command.access.tokens_env)
    if command.viewer and (command.tls.enabled or asks_for_tokens):
        raise ConfigError(
            "--viewer opens a plain connection without a token, which this server refuses; "
            "start `magic view HOST:PORT --credentials...` with a reader's token instead"
        )
    logs.configure(command.logs)
    tracing.configure(command.tracing, service="magic-server")
    from magic_server.server import Server, serve

    def ready(server: Server) -> None:
        target = server.address
        notify(f"READY=1\nSTATUS=serving on {target}")
        if command.progress == "json":
            ready = {
                "ready": True,
                "target": target,
                "metrics": server.metrics_address,
                "health": server.health_address,
            }
            sys.stdout.write(json.dumps(ready) + "\n")
            sys.stdout.flush()
        else:
            console.print(f"magic-slam server at {target}, data in {command.data_dir}")
            console.print(f"Join with: magic agent DATASET --server {target}", markup=False)
            if server.metrics_address is not None:
                console.print(f"Metrics at http://{server.metrics_address}/metrics", markup=False)

        if command.viewer:
            viewers.append(_start_viewer(target, command))

    viewers: list[subprocess.Popen] = []
    try:
        asyncio.run(serve(command, on_ready=ready))
    finally:
        for viewer in viewers:
            viewer.terminate()
            viewer.wait()
    return 0


def _start_viewer(target: str, command: ServeCommand) -> subprocess.Popen:
    """The live view of this server, at low priority: watching never slows the run."""
    page = ["--port", str(command.viewer_port), "--max-splats", str(command.viewer_splats)]
    arguments = [sys.executable, "-m", "magic_cli", "view", target, *page]
    tied = lifeline.tied(dict(os.environ))
    viewer = subprocess.Popen(arguments, stdin=subprocess.PIPE, env=tied)
    processes.give_way(viewer.pid)
    return viewer
