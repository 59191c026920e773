"""Children that a run starts end with it, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

# A driver: starts the child as `magic run` does, says its process id, and lives until it is killed.
DRIVER = """
import asyncio, sys
from pathlib import Path
from magic_cli import processes

async def main():
    arguments = ["serve", "--port", "0", "--progress", "json", "--data-dir", sys.argv[1]]
    child = await processes.start("server", arguments, log=Path(sys.argv[2]), threads=1)
    await processes.wait_ready(child, timeout_s=300)
    print(child.process.pid, flush=True)
    if sys.argv[3] == "stop":
        await processes.stop(child, timeout_s=300)
        print(child.exit_code, flush=True)
    else:
        await asyncio.Event().wait()

asyncio.run(main())
"""


def driver(tmp_path: Path, then: str) -> subprocess.Popen[str]:
    arguments = [str(tmp_path / "store"), str(tmp_path / "server.log"), then]
    return subprocess.Popen(
        [sys.executable, "-c", DRIVER, *arguments], stdout=subprocess.PIPE, text=True
    )


def runs(process_id: int) -> bool:
    """Whether a process lives; one that ended and that nobody asked about does not."""
    try:
        status = Path(f"/proc/{process_id}/stat").read_text()
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_server_drains_when_the_run_that_started_it_is_killed(tmp_path: Path):
    started = driver(tmp_path, "wait")
    assert started.stdout is not None
    server = int(started.stdout.readline())
    assert runs(server)
    started.send_signal(signal.SIGKILL)
    started.wait()
    deadline = time.monotonic() + 120
    while runs(server):
        if time.monotonic() > deadline:
            os.kill(server, signal.SIGKILL)
            pytest.fail("the server outlived the run")
        time.sleep(0.05)
    assert "Traceback" not in (tmp_path / "server.log").read_text()


def test_a_server_that_is_asked_to_stop_ends_as_before(tmp_path: Path):
    started = driver(tmp_path, "stop")
    printed, _ = started.communicate(timeout=300)
    assert printed.split()[1] == "0"
