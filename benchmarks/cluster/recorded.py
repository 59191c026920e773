"""How a server's database grows with recorded sub-map headers, from a thousand to a million.

The headers are those of a finished run, sent again under new names by a hundred agents: the tables,
the rows and the transactions are the server's own, only the blobs are not there. At each size it is
told what a new sub-map's transaction takes (synced to the disk), what reading one header and one
page of a listing take, and how long a restart reads what the index and the pose graph need.

Examples:
  magic run DATASET --scale 0.5 --out runs/room
  OMP_NUM_THREADS=1 python benchmarks/cluster/recorded.py runs/room --sizes 1000 10000 100000
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from magicslam.v1 import submap_pb2
from scale import rss_mib, spread

from magic_core.evaluation import RunFolder
from magic_core.wire import geometry, names
from magic_server.store import AgentRow, Asked, NewSubmap, SessionRow, Store, Vertex
from magic_server.store.submaps import Arrival

AGENTS = 100
TOGETHER = 500
"""Sub-maps of one transaction while the database is filled."""
SINGLE = 200
"""Sub-maps, headers and pages that are timed at each size."""


def database_mb(folder: Path) -> float:
    """Size of the database's files."""
    return round(sum(file.stat().st_size for file in folder.glob("magic.sqlite*")) / 1e6, 1)


async def recorded_headers(run: RunFolder) -> list[submap_pb2.SubmapHeader]:
    """The headers of a run's sub-maps."""
    found = []
    with ThreadPoolExecutor(2) as threads:
        async with Store(run.server_folder, threads) as store:
            for name in run.read_components().anchors:
                session, agent, index = names.parse_submap(name)
                row = await store.agents.session(session)
                stored = await store.submaps.stored(row, agent, index)
                found.append(submap_pb2.SubmapHeader.FromString(stored.header))
    return found


class Filling:
    """A store that recorded headers are put into, again and again."""

    def __init__(self, store: Store, headers: list[submap_pb2.SubmapHeader]) -> None:
        self._store, self._headers = store, headers
        self._agents: list[AgentRow] = []
        self._generator = np.random.default_rng(0)
        self.count = 0

    @property
    def session(self) -> SessionRow:
        """The only one."""
        return self._agents[0].session

    async def register(self) -> None:
        """Enter the agents."""
        descriptor = self._headers[0].image_descriptor
        for number in range(AGENTS):
            asked = Asked(uuid.uuid4().hex, bytes(32), time.time())
            entered = await self._store.agents.register(
                "fleet", f"a{number:02d}", model_id=descriptor.model_id,
                dimension=len(descriptor.vector), asked=asked,
            )  # fmt: skip
            self._agents.append(entered.agent)

    def arrival(self) -> Arrival:
        """The next sub-map; the agents take turns."""
        agent, index = self._agents[self.count % AGENTS], self.count // AGENTS
        found = Arrival(agent, self._new(agent, index), time.time())
        self.count += 1
        return found

    async def fill(self, size: int) -> float:
        """Have so many; returns the processor's seconds for each thousand."""
        started, before = time.process_time(), self.count
        while self.count < size:
            together = min(TOGETHER, size - self.count)
            await self._store.submaps.insert([self.arrival() for _ in range(together)])
        return 1e3 * (time.process_time() - started) / max(self.count - before, 1)

    def place(self) -> tuple[str, int]:
        """Agent and index of any stored one."""
        number = int(self._generator.integers(self.count))
        return self._agents[number % AGENTS].name, number // AGENTS

    def _new(self, agent: AgentRow, index: int) -> NewSubmap:
        header = submap_pb2.SubmapHeader()
        header.CopyFrom(self._headers[self.count % len(self._headers)])
        header.name = names.submap_name(agent.session.name, agent.name, index)
        header.request_id = uuid.uuid4().hex
        header.ClearField("odometry")
        if index:
            header.odometry.previous_index = index - 1
            header.odometry.previous_from_anchor.CopyFrom(geometry.pose_to_proto(np.eye(4)))
            header.odometry.information.extend(geometry.information_to_list(np.eye(6)))
        for blob in header.blobs:  # no two sub-maps have the same ones
            blob.sha256 = self._generator.bytes(32)
        digests = tuple(blob.sha256.hex() for blob in header.blobs)
        return NewSubmap(header, self._generator.bytes(32), 50_000, digests, Vertex.of(header))


async def measure(filling: Filling, store: Store, size: int, database: Path) -> dict:
    """Fill up to a size, then time what a server does with it."""
    fill_s = await filling.fill(size)
    added, read, listed = [], [], []
    for _ in range(SINGLE):
        arrival = filling.arrival()
        started = time.perf_counter()
        await store.submaps.insert([arrival])
        added.append(time.perf_counter() - started)
    for _ in range(SINGLE):
        agent, index = filling.place()
        started = time.perf_counter()
        await store.submaps.stored(filling.session, agent, index)
        read.append(time.perf_counter() - started)
        after = int(filling.count * np.random.default_rng(len(listed)).random())
        started = time.perf_counter()
        await store.submaps.page(filling.session, after=after)
        listed.append(time.perf_counter() - started)
    before = rss_mib()
    started = time.process_time()
    vertices = await store.submaps.vertices(filling.session)
    start_s = time.process_time() - started
    assert len(vertices) == filling.count
    return {
        "size": size,
        "filled_s_per_1000": round(fill_s, 2),
        "transaction_ms": spread(added),
        "header_ms": spread(read),
        "page_of_100_ms": spread(listed),
        "restart_reads_s": round(start_s, 2),
        "restart_mib": round(rss_mib() - before, 1),
        "database_mb": database_mb(database),
    }


async def main(options: argparse.Namespace) -> None:
    """One store that grows from size to size."""
    headers = await recorded_headers(RunFolder(options.run))
    sizes = [len(header.SerializeToString()) for header in headers]
    print(json.dumps({"recorded": len(headers), "header_bytes_mean": float(np.mean(sizes))}))
    with tempfile.TemporaryDirectory(dir=options.folder) as folder, ThreadPoolExecutor(2) as some:
        async with Store(Path(folder), some) as store:
            filling = Filling(store, headers)
            await filling.register()
            for size in options.sizes:
                found = await measure(filling, store, size, Path(folder))
                print(json.dumps(found), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="the folder of a finished `magic run`")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--folder", type=Path, help="where the database is made and removed")
    asyncio.run(main(parser.parse_args()))
