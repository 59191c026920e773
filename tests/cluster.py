"""A real Dask scheduler and real `magic worker`s as processes, started and killed by tests."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
START_TIMEOUT_S = 180.0


class Cluster:
    """Processes of one cluster; every one ends with it."""

    def __init__(self, folder: Path, *, scheme: str = "tcp", options: tuple[str, ...] = ()) -> None:
        """`options` are further arguments of the scheduler."""
        self._folder = folder
        self._options = options
        self.port = _free_port()
        self.address = f"{scheme}://127.0.0.1:{self.port}"
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.workers: dict[str, subprocess.Popen[bytes]] = {}

    def start_scheduler(self) -> None:
        """Start it and wait until it listens."""
        command = ["-m", "dask", "scheduler", "--host", self.address, "--no-dashboard"]
        self.scheduler = self._start("scheduler", [*command, *self._options])
        end = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < end:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port)):
                return
            time.sleep(0.05)
        raise TimeoutError(self.log("scheduler"))

    def start_worker(self, name: str, *options: str, wait: bool = True) -> None:
        """Start a worker and wait until it has joined."""
        command = ["-m", "magic_cli", "worker", self.address, "--name", name, "--progress", "json"]
        self.workers[name] = self._start(name, [*command, "--niceness", "0", *options])
        if wait:
            self.wait_joined(name)

    def wait_joined(self, name: str, *, times: int = 1) -> dict:
        """What a worker said when it joined, the last of so many times."""
        end = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < end:
            lines = (self._folder / f"{name}.out").read_text().splitlines()
            if len(lines) >= times:
                return json.loads(lines[times - 1])
            time.sleep(0.05)
        raise TimeoutError(self.log(name))

    def log(self, name: str) -> str:
        """What a process wrote to its stderr."""
        return (self._folder / f"{name}.log").read_text()

    def kill(self, name: str) -> None:
        """As a loss of the machine: no process of it says goodbye."""
        process = self.workers.pop(name) if name in self.workers else self.scheduler
        assert process is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def owner_of(self, process: int) -> str:
        """The worker that started a job's process."""
        group = os.getpgid(process)
        return next(name for name, worker in self.workers.items() if worker.pid == group)

    def stop(self) -> None:
        """End everything."""
        for name in [*self.workers]:
            self.kill(name)
        if self.scheduler is not None:
            self.kill("scheduler")

    def _start(self, name: str, arguments: list[str]) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "PYTHONPATH": f"{REPOSITORY}:{REPOSITORY / 'proto'}"}
        out, log = self._folder / f"{name}.out", self._folder / f"{name}.log"
        with out.open("wb") as stdout, log.open("ab") as stderr:
            return subprocess.Popen(
                [sys.executable, *arguments], cwd=self._folder, env=environment,
                stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, start_new_session=True,
            )  # fmt: skip


@contextlib.contextmanager
def running_cluster(folder: Path, **options) -> Iterator[Cluster]:
    """A cluster with a scheduler and no workers yet, for a block."""
    folder.mkdir(parents=True, exist_ok=True)
    cluster = Cluster(folder, **options)
    try:
        cluster.start_scheduler()
        yield cluster
    finally:
        cluster.stop()


def alive(process: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


# Jobs that tests send to workers


def note(file: Path, text: str) -> str:
    """Append a line to a file."""
    with file.open("a") as stream:
        stream.write(f"{text}\n")
    return text


def merge_submaps(file: Path, text: str) -> str:
    """As `note`, as urgent as a merge."""
    return note(file, text)


def pid_once_there(file: Path) -> int:
    """Wait for a file; say which process waited."""
    note(file.with_suffix(".waiting"), str(os.getpid()))
    while not file.exists():
        time.sleep(0.02)
    return os.getpid()
