"""The event loop never stands still for more than 50 ms, whatever the server is doing."""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import signal
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from magic_agent.client import ClientConfig, MagicClient
from magic_core.wire import records
from magic_server.config import ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loop_monitor import LoopMonitor
from magic_server.loops import LoopConfig
from magic_server.server import Server

REPOSITORY = Path(__file__).resolve().parents[2]


REFERENCE_S = 0.004
"""What `fixed_work` takes where a stall is one from 50 ms on."""


def fixed_work() -> float:
    """Processor seconds of a piece of work like that of the loop."""
    began = time.thread_time()
    for number in range(4000):
        records.UploadPosition(blob_index=number, offset=0, durable_bytes=0, stored=False)
    return time.thread_time() - began


def scheduler_is_known() -> bool:
    """Whether a busy machine can be told from a loop that stands still."""
    file = Path("/proc/self/schedstat")
    return file.exists() and int(file.read_text().split()[0]) > 0


@pytest.fixture
def threshold_s() -> Iterator[float]:
    """From when on the loop stands still: 50 ms, or more where the machine is slower.

    A pass of the garbage collector over all that other tests have loaded is none of the server's.
    """
    if not scheduler_is_known():
        pytest.skip("this system does not say how long a thread waited for a processor")
    gc.collect()
    gc.freeze()
    slower = statistics.median(fixed_work() for _ in range(15)) / REFERENCE_S
    yield 0.05 * max(1.0, slower)
    gc.unfreeze()


async def test_the_monitor_sees_a_blocked_loop_and_who_blocked_it() -> None:
    async with LoopMonitor(threshold_s=0.3) as monitor:
        await asyncio.sleep(0.05)
        block_the_loop()
        await asyncio.sleep(0.05)
    assert monitor.count >= 1
    assert monitor.stalls[0].gap_s >= 1.0
    assert "block_the_loop" in monitor.stalls[0].stack
    assert monitor.stalls[0].at_s > 0.0


def block_the_loop() -> None:
    time.sleep(1.2)


async def test_the_monitor_leaves_work_on_threads_alone(threshold_s: float) -> None:
    async with LoopMonitor(threshold_s=threshold_s) as monitor:
        await asyncio.to_thread(time.sleep, 0.3)
    assert monitor.count == 0, monitor.stalls[0]
    assert monitor.beats > 1


async def test_a_monitor_that_never_began_stops() -> None:
    await LoopMonitor().stop()


async def test_a_process_that_was_stopped_did_not_stall() -> None:
    script = (
        "import asyncio\n"
        "from magic_server.loop_monitor import LoopMonitor\n"
        "async def main():\n"
        "    async with LoopMonitor(threshold_s=0.5) as monitor:\n"
        "        print('watching', flush=True)\n"
        "        await asyncio.to_thread(input)\n"
        "        await asyncio.sleep(0.1)\n"
        "    print(monitor.count)\n"
        "asyncio.run(main())\n"
    )
    watched = await asyncio.create_subprocess_exec(
        sys.executable, "-c", script, cwd=REPOSITORY,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert watched.stdout is not None
    await watched.stdout.readline()
    await asyncio.sleep(0.2)
    watched.send_signal(signal.SIGSTOP)
    await asyncio.sleep(2.0)
    watched.send_signal(signal.SIGCONT)
    output, _ = await watched.communicate(b"\n")
    assert int(output) == 0


async def test_no_stall_while_large_submaps_arrive_and_loops_are_solved(
    server_config: ServerConfig, threshold_s: float
) -> None:
    config = dataclasses.replace(
        server_config, jobs=JobConfig(workers=2), loops=LoopConfig(top_k=1)
    )
    async with Server(config) as server, MagicClient(server.address, ClientConfig()) as client:
        load = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.load", server.address, "--agents", "2", "--submaps", "2",
            cwd=REPOSITORY, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        async with LoopMonitor(threshold_s=threshold_s) as monitor:
            output, _ = await load.communicate()
            coordinator = await server.sessions.named("load")
            assert await coordinator.idle(timeout_s=600)
        assert int(output) > 4 * 2_000_000
        assert (await client.get_corrected_poses("load")).revision > 0
        assert len((await client.list_loops("load")).candidates) > 0
    assert monitor.count == 0, monitor.stalls[0]
