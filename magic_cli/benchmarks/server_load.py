"""Many agents submit at once while others ask: what the server does with it."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from magic_agent.client import ClientConfig, MagicClient
from magic_cli.benchmarks.server_recording import SESSION, Recording, replayed
from magic_core.submap import Descriptor
from magic_core.wire import geometry, names

ASK_EVERY_S = 0.1
SAMPLE_EVERY_S = 0.5
WARM_UP_SHARE = 0.2
"""Memory is looked at once this share of the sub-maps is there: pools and caches are full then."""


@dataclass(slots=True)
class Load:
    """What was sent and seen."""

    sent_bytes: int = 0
    submaps: int = 0
    seconds: float = 0.0
    rpc_s: dict[str, list[float]] = field(default_factory=dict)
    memory: list[tuple[int, int]] = field(default_factory=list)
    """(sub-maps stored, bytes resident in the server)."""
    begun: asyncio.Event = field(default_factory=asyncio.Event)
    """Set once a sub-map is stored."""
    server_cpu_s: float = 0.0
    client_cpu_s: float = 0.0

    def line(self) -> str:
        """How far it is, in a line."""
        rate = self.submaps / self.seconds if self.seconds else 0.0
        memory = self.memory[-1][1] / 1e6 if self.memory else 0.0
        return (
            f"{self.submaps} sub-maps in {self.seconds:.0f} s, {rate:.1f}/s, server {memory:.0f} MB"
        )

    def percentiles_ms(self) -> dict[str, dict[str, float]]:
        """p50 and p99 of each call, milliseconds."""
        return {
            name: {
                "p50": 1e3 * float(np.percentile(times, 50)),
                "p99": 1e3 * float(np.percentile(times, 99)),
                "calls": len(times),
            }
            for name, times in self.rpc_s.items()
        }

    def growth_bytes_per_submap(self) -> float:
        """Slope of the server's resident memory over the sub-maps it stored, after the warm-up."""
        samples = np.array(
            [m for m in self.memory if WARM_UP_SHARE * self.submaps <= m[0] <= self.submaps]
        )
        if len(samples) < 3 or np.ptp(samples[:, 0]) == 0:
            return float("nan")
        return float(np.polyfit(samples[:, 0], samples[:, 1], 1)[0])


async def run_load(
    address: str,
    recording: Recording,
    *,
    agents: int,
    submaps: int,
    server_pid: int,
    progress: Callable[[Load], None],
    stop: asyncio.Event,
) -> Load:
    """`agents` connections submit `submaps` sub-maps together; a reader asks all the while.

    Ends early, with what there is, once `stop` is set.
    """
    load = Load()
    server = psutil.Process(server_pid)
    cpu = _cpu_of(server), time.process_time()
    shares = [range(submaps)[agent::agents] for agent in range(agents)]
    started = time.perf_counter()
    async with asyncio.TaskGroup() as group:
        watchers = [
            group.create_task(_ask(address, recording, load)),
            group.create_task(_sample(server, load)),
        ]
        watchers.append(group.create_task(_show(load, started, progress)))
        uploads = group.create_task(_submit_all(address, recording, load, shares))
        stopping = group.create_task(stop.wait())
        await asyncio.wait((uploads, stopping), return_when=asyncio.FIRST_COMPLETED)
        load.seconds = time.perf_counter() - started
        for task in (*watchers, uploads, stopping):
            task.cancel()
    load.server_cpu_s = _cpu_of(server) - cpu[0]
    load.client_cpu_s = time.process_time() - cpu[1]
    return load


async def _submit_all(address: str, recording: Recording, load: Load, shares: list[range]) -> None:
    async with asyncio.TaskGroup() as group:
        for agent, share in enumerate(shares):
            work = _submit(address, recording, load, agent=agent, count=len(share))
            group.create_task(work)


async def _submit(
    address: str, recording: Recording, load: Load, *, agent: int, count: int
) -> None:
    async with MagicClient(address, ClientConfig(rpc_timeout_s=120.0)) as client:
        await client.register_agent(
            SESSION, f"load_{agent}", model_id=recording.model_id, dimension=recording.dimension
        )
        for index in range(count):
            submap = await asyncio.to_thread(replayed, recording, agent=agent, index=index)
            await _timed(load, "SubmitSubmap", client.submit_encoded(submap))
            load.sent_bytes += sum(map(len, submap.blobs))
            load.submaps += 1
            load.begun.set()


async def _ask(address: str, recording: Recording, load: Load) -> None:
    """What readers ask: all poses, the loops of a sub-map, the places like an image."""
    header = recording.walks[0][0].encoded.header
    descriptor: Descriptor = geometry.descriptor_from_proto(header.image_descriptor)
    oldest = names.submap_name(SESSION, "load_0", 0)
    async with MagicClient(address, ClientConfig(rpc_timeout_s=120.0)) as client:
        await load.begun.wait()
        while True:
            await _timed(load, "GetCorrectedPoses", client.get_corrected_poses(SESSION))
            await asyncio.sleep(ASK_EVERY_S)
            await _timed(load, "QueryLoops", client.query_loops(descriptor, session=SESSION))
            await asyncio.sleep(ASK_EVERY_S)
            if load.submaps > len(recording.walks) * 8:
                await _timed(load, "QueryLoops", client.query_loops(oldest))


async def _timed(load: Load, name: str, call: Awaitable[object]) -> None:
    started = time.perf_counter()
    await call
    load.rpc_s.setdefault(name, []).append(time.perf_counter() - started)


async def _sample(server: psutil.Process, load: Load) -> None:
    while True:
        load.memory.append((load.submaps, server.memory_info().rss))
        await asyncio.sleep(SAMPLE_EVERY_S)


async def _show(load: Load, started: float, progress: Callable[[Load], None]) -> None:
    while True:
        load.seconds = time.perf_counter() - started
        progress(load)
        await asyncio.sleep(SAMPLE_EVERY_S)


def _cpu_of(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def plain_write(folder: Path, sizes: list[int]) -> float:
    """Seconds to write files of these sizes one after the other, each synced to the disk."""
    data = os.urandom(max(sizes))
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    for number, size in enumerate(sizes):
        with (folder / f"{number}").open("wb") as file:
            file.write(data[:size])
            file.flush()
            os.fsync(file.fileno())
    return time.perf_counter() - started
