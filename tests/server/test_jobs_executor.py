"""Jobs in worker processes: results, errors, dying workers, dying servers."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from magic_core.errors import CorruptData, Unavailable
from magic_core.gaussians import codec
from magic_server.jobs import JobConfig, ProcessExecutor
from tests.waiting import eventually

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def config() -> JobConfig:
    return JobConfig(workers=1, niceness=3)


async def test_a_job_gives_its_result_or_its_error(config: JobConfig) -> None:
    jobs = ProcessExecutor(config)
    try:
        assert await jobs.run(divmod, 17, 5) == (3, 2)
        with pytest.raises(ZeroDivisionError):
            await jobs.run(divmod, 17, 0)
        with pytest.raises(CorruptData, match="starts with") as caught:
            await jobs.run(codec.decode, b"nothing of ours")
        assert caught.value.grpc_code == "DATA_LOSS"
    finally:
        await jobs.close()


async def test_a_worker_is_limited_and_yields_to_the_server(config: JobConfig) -> None:
    jobs = ProcessExecutor(config)
    try:
        assert await jobs.run(os.getenv, "OMP_NUM_THREADS") == "1"
        assert await jobs.run(os.getenv, "MAGIC_THREADS") == "1"
        assert await jobs.run(os.nice, 0) == os.nice(0) + 3
    finally:
        await jobs.close()


async def test_a_job_whose_worker_dies_is_tried_once_more(
    config: JobConfig, tmp_path: Path
) -> None:
    jobs = ProcessExecutor(config)
    try:
        first = await jobs.run(os.getpid)
        running = asyncio.create_task(jobs.run(time.sleep, 1.0))
        await asyncio.sleep(0.2)  # on its way or running: the same is expected of both
        os.kill(first, signal.SIGKILL)
        assert await running is None
        assert await jobs.run(os.getpid) != first
        with pytest.raises(Unavailable, match="died twice during _exit"):
            await jobs.run(os._exit, 1)
        assert await jobs.run(divmod, 7, 2) == (3, 1)
    finally:
        await jobs.close()


async def test_closing_ends_a_running_job_and_its_worker(config: JobConfig) -> None:
    jobs = ProcessExecutor(config)
    worker = await jobs.run(os.getpid)
    running = [asyncio.create_task(jobs.run(time.sleep, 600)) for _ in range(5)]
    await asyncio.sleep(0.1)  # wherever they are: on their way, waiting, running
    await jobs.close()
    for job in running:
        with pytest.raises(Unavailable, match="stopping"):
            await job
    await eventually(lambda: not alive(worker))
    with pytest.raises(Unavailable, match="stopping"):
        await jobs.run(os.getpid)


async def test_a_caller_that_gives_up_while_jobs_end_stays_cancelled(config: JobConfig) -> None:
    jobs = ProcessExecutor(config)
    running = asyncio.create_task(jobs.run(time.sleep, 600))
    await asyncio.sleep(0.1)
    running.cancel()
    await jobs.close()
    with pytest.raises(asyncio.CancelledError):
        await running


def test_workers_end_with_a_server_that_is_killed() -> None:
    script = (
        "import asyncio, os\n"
        "from magic_server.jobs import ProcessExecutor\n"
        "async def main():\n"
        "    print(await ProcessExecutor().run(os.getpid), flush=True)\n"
        "    await asyncio.sleep(60)\n"
        "asyncio.run(main())\n"
    )
    server = subprocess.Popen(
        [sys.executable, "-c", script], cwd=REPOSITORY, stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    worker = int(server.stdout.readline())
    assert alive(worker)
    server.kill()
    server.wait()
    end = time.monotonic() + 60
    while alive(worker) and time.monotonic() < end:
        time.sleep(0.02)
    assert not alive(worker)


def alive(process: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"
