"""Real server processes that start in a moment: a parent that has everything loaded forks them.

`python -m tests.faults.server_process` reads one line of JSON per server from stdin, forks, and
prints the server's address once it serves. Every server is a process of its own, with its own
sockets, threads and workers, and dies by a signal like any other; only the imports are shared.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from pathlib import Path
from typing import IO, Any

REPOSITORY = Path(__file__).resolve().parents[2]


class ServerProcess:
    """One server, started by `ServerForge.start`."""

    def __init__(self, pid: int, forge: ServerForge) -> None:
        self.pid = pid
        self._forge = forge

    async def ready(self) -> str:
        """Its address, once it serves."""
        return (await self._forge.answer("ready", self.pid))["address"]

    async def end(self, number: signal.Signals = signal.SIGKILL) -> int:
        """Send a signal and wait for the end; returns the wait status."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)
        return (await self._forge.answer("ended", self.pid))["status"]


class ServerForge:
    """Starts server processes.

    async with ServerForge() as forge:
        server = await forge.start({"data_dir": ...})
    """

    def __init__(self, log: IO[bytes] | int = asyncio.subprocess.DEVNULL) -> None:
        """`log` takes what the servers write to stderr."""
        self._log = log
        self._process: asyncio.subprocess.Process | None = None
        self._answers: dict[tuple[str, int], asyncio.Future[dict]] = {}
        self._reading: asyncio.Task[None] | None = None
        self._starting = asyncio.Lock()

    async def __aenter__(self) -> ServerForge:
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.faults.server_process",
            cwd=REPOSITORY, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            stderr=self._log,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        self._reading = asyncio.create_task(self._read())
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._reading is not None
        self._process.stdin.close()  # it ends what it started, and then itself
        await self._process.wait()
        await self._reading

    async def start(self, settings: dict[str, Any]) -> ServerProcess:
        """Fork a server with these settings (see `_config`); it opens its store at once."""
        assert self._process is not None
        assert self._process.stdin is not None
        async with self._starting:
            self._process.stdin.write(json.dumps(settings).encode() + b"\n")
            await self._process.stdin.drain()
            started = await self.answer("started", 0)
        return ServerProcess(started["pid"], self)

    async def answer(self, event: str, pid: int) -> dict:
        """The next event of this kind about a server."""
        key = (event, pid)
        future = self._answers.setdefault(key, asyncio.get_running_loop().create_future())
        try:
            async with asyncio.timeout(120):
                return await asyncio.shield(future)
        finally:
            del self._answers[key]

    async def _read(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            event = json.loads(line)
            pid = 0 if event["event"] == "started" else event["pid"]
            key = (event["event"], pid)
            future = self._answers.setdefault(key, asyncio.get_running_loop().create_future())
            if not future.done():
                future.set_result(event)


def _say(event: str, **values: Any) -> None:
    os.write(1, json.dumps({"event": event, **values}).encode() + b"\n")


def _config(settings: dict[str, Any]):
    from magic_core.wire import Transport
    from magic_server.cluster_config import ClusterConfig
    from magic_server.config import ListenConfig, ServerConfig
    from magic_server.jobs import JobConfig
    from magic_server.loops import LoopConfig
    from magic_server.store_config import StoreConfig

    loops = LoopConfig(
        min_similarity=settings.get("min_similarity", 1.0), top_k=settings.get("top_k", 6)
    )
    transport = Transport(
        keepalive_s=settings.get("keepalive_s", 30.0),
        keepalive_timeout_s=settings.get("keepalive_timeout_s", 10.0),
    )
    return ServerConfig(
        data_dir=Path(settings["data_dir"]),
        store=StoreConfig(database=settings.get("database", "")),
        cluster=ClusterConfig(replica=settings.get("replica", "")),
        listen=ListenConfig(
            port=settings.get("port", 0),
            stop_grace_s=settings.get("stop_grace_s", 2.0),
            transport=transport,
        ),
        jobs=JobConfig(workers=1, niceness=settings.get("niceness", 0)),
        loops=loops,
    )


def _serve(settings: dict[str, Any]) -> None:
    """In the forked process: serve until a signal ends it."""
    from magic_server.server import serve

    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)

    def ready(server: Any) -> None:
        _say("ready", pid=os.getpid(), address=server.address)

    asyncio.run(serve(_config(settings), on_ready=ready))


def main() -> None:
    """Fork a server for every line; kill what still runs when the lines end."""
    # Everything a server needs, once.
    import scipy.special  # noqa: F401

    import magic_server.registration.register
    import magic_server.server  # noqa: F401

    running: set[int] = set()

    def reap(*_: object) -> None:
        with contextlib.suppress(ChildProcessError):
            while True:
                pid, status = os.waitpid(-1, os.WNOHANG)
                if not pid:
                    return
                running.discard(pid)
                _say("ended", pid=pid, status=status)

    signal.signal(signal.SIGCHLD, reap)
    for line in sys.stdin:
        settings = json.loads(line)
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
        pid = os.fork()
        if not pid:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
            code = 1
            try:
                sys.stdin.close()
                _serve(settings)
                code = 0
            except BaseException:
                import traceback

                traceback.print_exc()
            finally:
                os._exit(code)
        running.add(pid)
        _say("started", pid=pid)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
    for pid in list(running):
        os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    main()
