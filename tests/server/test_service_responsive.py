"""The event loop never stands still for more than 50 ms, whatever the server is doing."""

from __future__ import annotations

import asyncio
import dataclasses
import sys
import time
from pathlib import Path

from magic_agent.client import ClientConfig, MagicClient
from magic_server.config import ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loop_monitor import LoopMonitor
from magic_server.loops import LoopConfig
from magic_server.server import Server

REPOSITORY = Path(__file__).resolve().parents[2]


async def test_the_monitor_sees_a_blocked_loop_and_who_blocked_it() -> None:
    async with LoopMonitor(threshold_s=0.05) as monitor:
        await asyncio.sleep(0.05)
        block_the_loop()
        await asyncio.sleep(0.05)
    assert monitor.count == 1
    assert monitor.stalls[0].gap_s >= 0.3
    assert "block_the_loop" in monitor.stalls[0].stack


def block_the_loop() -> None:
    time.sleep(0.35)


async def test_the_monitor_leaves_work_on_threads_alone() -> None:
    async with LoopMonitor(threshold_s=0.05) as monitor:
        await asyncio.to_thread(time.sleep, 0.3)
    assert monitor.count == 0
    assert monitor.beats > 10


async def test_no_stall_while_large_submaps_arrive_and_loops_are_solved(
    server_config: ServerConfig,
) -> None:
    config = dataclasses.replace(
        server_config, jobs=JobConfig(workers=2), loops=LoopConfig(top_k=1)
    )
    async with Server(config) as server, MagicClient(server.address, ClientConfig()) as client:
        load = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.load", server.address, "--agents", "2", "--submaps", "2",
            cwd=REPOSITORY, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        async with LoopMonitor(threshold_s=0.05) as monitor:
            output, _ = await load.communicate()
            coordinator = await server.sessions.named("load")
            assert await coordinator.idle(timeout_s=200)
        assert int(output) > 4 * 2_000_000
        assert (await client.get_corrected_poses("load")).revision > 0
        assert len((await client.list_loops("load")).candidates) > 0
    assert monitor.count == 0, monitor.stalls[0]
