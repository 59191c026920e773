"""The server and the agents of a local run as child processes, and what they say on the way."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from magic_cli import lifeline
from magic_core.errors import Unavailable

Progress = Callable[[str, dict], None]
"""Called with a child's name and the newest figures it printed."""

_BELOW_US = 5
"""Steps of niceness."""
STREAM_LIMIT_BYTES = 1 << 20


@dataclass(slots=True)
class Child:
    """One child process: its name, its log file and how it ended."""

    name: str
    process: Process
    log: Path
    figures: dict = field(default_factory=dict)

    @property
    def exit_code(self) -> int | None:
        return self.process.returncode

    def tail(self, lines: int = 15) -> str:
        """The last lines of its log, to show when it failed."""
        with contextlib.suppress(OSError):
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])
        return ""


def fair_threads(sharers: int) -> int:
    """Kernel threads for each of several processes that share this machine's cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (cores or 1) // max(1, sharers))


def environment(threads: int) -> dict[str, str]:
    """The environment of a child that may use `threads` threads; an explicit setting wins."""
    result = dict(os.environ)
    for name in ("MAGIC_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        result.setdefault(name, str(threads))
    result["PYTHONUNBUFFERED"] = "1"
    return result


async def start(name: str, arguments: list[str], *, log: Path, threads: int) -> Child:
    """Start `magic ARGUMENTS` as a child that ends with us; its stderr goes to a log file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as stream:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "magic_cli", *arguments,
            stdin=PIPE, stdout=PIPE, stderr=stream,
            env=lifeline.tied(environment(threads)), limit=STREAM_LIMIT_BYTES,
            # A Ctrl-C on the terminal reaches the driver alone, which then asks its children.
            start_new_session=True,
        )  # fmt: skip
    return Child(name=name, process=process, log=log)


def give_way(pid: int) -> None:
    """Lower the priority of a child below our own: what it does can wait."""
    with contextlib.suppress(AttributeError, OSError):  # a courtesy that not every system has
        own = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, pid, min(own + _BELOW_US, 19))


async def follow(child: Child, progress: Progress) -> int:
    """Read a child's JSON lines until it ends; return its exit code."""
    assert child.process.stdout is not None
    async for line in child.process.stdout:
        with contextlib.suppress(json.JSONDecodeError):
            figures = json.loads(line)
            if isinstance(figures, dict):
                child.figures.update(figures)
                progress(child.name, child.figures)
    return await child.process.wait()


async def wait_ready(child: Child, *, timeout_s: float) -> dict:
    """The first JSON line of a child, which says that it is ready.

    Raises Unavailable with the end of its log when it ends or stays silent instead.
    """
    assert child.process.stdout is not None
    try:
        line = await asyncio.wait_for(child.process.stdout.readline(), timeout_s)
        return json.loads(line)
    except (TimeoutError, json.JSONDecodeError) as error:
        await stop(child)
        raise Unavailable(f"{child.name} did not start:\n{child.tail()}") from error


def ask_to_stop(child: Child) -> None:
    """Send SIGTERM: an agent leaves early, a server drains."""
    if child.exit_code is None:
        with contextlib.suppress(ProcessLookupError):
            child.process.send_signal(signal.SIGTERM)


async def stop(child: Child, *, timeout_s: float = 20.0) -> None:
    """Ask a child to stop and kill its process group when it does not."""
    ask_to_stop(child)
    try:
        await asyncio.wait_for(child.process.wait(), timeout_s)
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, signal.SIGKILL)
        await child.process.wait()
