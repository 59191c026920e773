"""The server under load, in a process of its own that watches its event loop from when it is ready.

Prints a line with its address once it serves, and one with what it saw when it has stopped.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from pathlib import Path

from magic_server.config import ListenConfig, ServerConfig
from magic_server.loop_monitor import LoopMonitor
from magic_server.server import Server, serve

STALL_S = 0.05


def config_of(data_dir: Path) -> ServerConfig:
    """The default server on a port that the system chooses."""
    return ServerConfig(data_dir=data_dir, listen=ListenConfig(port=0))


async def run(data_dir: Path) -> None:
    """Serve until told to stop."""
    monitor = LoopMonitor(threshold_s=STALL_S)

    def ready(server: Server) -> None:
        # Starting loads libraries, which hold the interpreter lock; nobody is served meanwhile.
        monitor.start()
        print(json.dumps({"address": server.address}), flush=True)

    try:
        await serve(config_of(data_dir), on_ready=ready)
    finally:
        await monitor.stop()
    worst = [
        {
            "ms": round(1e3 * stall.seconds),
            "at_s": round(stall.at_s, 1),
            "cpu_ms": round(1e3 * stall.cpu_s),
            "gc_ms": round(1e3 * stall.gc_s),
            "stack": stall.stack.splitlines()[-6:],
        }
        for stall in monitor.stalls[:5]
    ]
    print(
        json.dumps(
            {"stalls": monitor.count, "longest_ms": 1e3 * monitor.longest_s, "worst": worst}
        ),
        flush=True,
    )


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    asyncio.run(run(Path(sys.argv[1])))
