"""Real processes on a small generated flat."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def flat(tmp_path_factory) -> Path:
    """Four short walks through the flat, 160x120, in the Replica layout."""
    from magic_core.data import write_replica
    from magic_core.data.synthetic import SyntheticConfig, synthetic_flat

    config = SyntheticConfig(agents=4, frames=36, width=160, height=120, detail="draft")
    return write_replica(synthetic_flat(config), tmp_path_factory.mktemp("flat") / "data")


class Processes:
    """`magic` commands as child processes; whatever still runs at the end is killed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen] = []

    def start(self, name: str, *arguments: str) -> subprocess.Popen:
        environment = {**os.environ, "MAGIC_THREADS": "1", "OMP_NUM_THREADS": "1"}
        log = (self._folder / f"{name}.log").open("w")
        process = subprocess.Popen(
            [sys.executable, "-m", "magic_cli", *arguments],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            cwd=REPOSITORY,
            env=environment,
        )
        self._running.append(process)
        return process

    def log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()

    def stop_all(self) -> None:
        for process in self._running:
            if process.poll() is None:
                process.kill()
            process.wait()


@pytest.fixture
def processes(tmp_path):
    started = Processes(tmp_path)
    yield started
    started.stop_all()


def first_line(process: subprocess.Popen) -> dict:
    """The first JSON line a process prints."""
    assert process.stdout is not None
    return json.loads(process.stdout.readline())


def wait_for(process: subprocess.Popen, key: str, least: int) -> None:
    """Read a process's JSON lines until one of its figures reaches a value."""
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line).get(key, 0) >= least:
            return
    raise AssertionError(f"the process ended before {key} reached {least}")


def wait_until(condition, *, timeout_s: float = 120.0) -> None:
    """Poll a condition; fails when it never holds."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "the awaited state never came"
        time.sleep(0.2)
