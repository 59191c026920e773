"""How a server grows with recorded sub-map headers, from a thousand to a million of them.

The headers are those of a finished run, sent again under new names by a hundred agents, ten of
each place: the tables, the rows and the transactions are the server's own, only the blobs are not
there. At each size it is told what a new sub-map's transaction takes (synced to the disk), what
reading one header and one page of a listing take, and what a server takes that is started on it:
time, memory, and how long its index is asked. Between two sizes rows are put in by many, without
the index of blobs, which is made again before anything is measured.

Examples:
  magic run DATASET --scale 0.5 --out runs/room
  OMP_NUM_THREADS=1 python benchmarks/cluster/recorded.py runs/room --sizes 1000 10000 100000
  ... --database postgresql+asyncpg://magic:PASSWORD@127.0.0.1/magic   # and pgvector
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import sqlalchemy as sa
from filling import EACH, SESSION, Filling, recorded_headers
from scale import rss_mib, spread

from magic_core.evaluation import RunFolder
from magic_core.wire import names
from magic_server.cluster_config import ClusterConfig
from magic_server.config import ListenConfig, ServerConfig
from magic_server.coordinator import SessionCoordinator
from magic_server.jobs import JobConfig
from magic_server.posegraph import PoseGraphConfig
from magic_server.server import Server
from magic_server.store import Store, schema
from magic_server.store_config import StoreConfig

REPLICA = "measured"
SINGLE = 200
"""Sub-maps, headers, pages and queries that are timed at each size."""
NEIGHBOURS = 48
"""That a new sub-map asks for."""


@contextlib.asynccontextmanager
async def opened(folder: Path, config: StoreConfig) -> AsyncIterator[Store]:
    """The store, for whoever fills and measures it."""
    with ThreadPoolExecutor(2) as threads:
        async with Store(folder, threads, config=config, replica=REPLICA) as store:
            if store.leases is not None:
                store.leases.begin(address="127.0.0.1:1", lease_s=3600.0)
            yield store


async def measure_store(filling: Filling, store: Store) -> dict:
    """Time what a server does with it one by one."""
    added, read, listed = [], [], []
    for _ in range(SINGLE):
        arrival = filling.arrival()
        started = time.perf_counter()
        await store.submaps.insert([arrival])
        added.append(time.perf_counter() - started)
    for number in range(SINGLE):
        agent, index = filling.some()
        started = time.perf_counter()
        await store.submaps.stored(filling.session, agent, index)
        read.append(time.perf_counter() - started)
        after = int(filling.count * np.random.default_rng(number).random())
        started = time.perf_counter()
        await store.submaps.page(filling.session, after=after)
        listed.append(time.perf_counter() - started)
    async with store._database.write(filling.session.id) as connection:
        new = schema.submaps.c.id > filling.count - SINGLE
        await connection.execute(sa.update(schema.submaps).where(new).values(searched=True))
    return {
        "transaction_ms": spread(added),
        "header_ms": spread(read),
        "page_of_100_ms": spread(listed),
    }


async def database_mb(store: Store, folder: Path) -> float:
    """What the database takes on the disk."""
    if store._database.engine.shared:
        size = sa.select(sa.func.pg_database_size(sa.func.current_database()))
        async with store._database.read() as connection:
            return round((await connection.scalar(size) or 0) / 1e6, 1)
    return sqlite_mb(folder)


def sqlite_mb(folder: Path) -> float:
    """Size of the files of SQLite."""
    return round(sum(file.stat().st_size for file in folder.glob("magic.sqlite*")) / 1e6, 1)


def now_mib() -> float:
    """The memory that this process has now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * 4096 / (1 << 20), 1)


async def measure_start(folder: Path, config: StoreConfig) -> dict:
    """Start a server on the store and ask its index. Needs a process of its own."""
    settings = ServerConfig(
        data_dir=folder,
        store=config,
        cluster=ClusterConfig(replica=REPLICA),
        listen=ListenConfig(port=0),
        jobs=JobConfig(workers=1),
        posegraph=PoseGraphConfig(hierarchy="off"),
    )
    started, ticked = time.perf_counter(), time.process_time()
    async with Server(settings) as server:
        while (found := server.sessions.found(SESSION)) is None:  # noqa: ASYNC110  # nobody tells
            await asyncio.sleep(0.01)
        wall_s, processor_s = time.perf_counter() - started, time.process_time() - ticked
        return {
            "start_wall_s": round(wall_s, 2),
            "start_s": round(processor_s, 2),
            "start_peak_mib": rss_mib(),
            "started_mib": now_mib(),
        } | await measure_queries(found)


async def measure_queries(session: SessionCoordinator) -> dict:
    """How long the index is asked, and how many of a place it finds."""
    rows = [row async for row in _names_of_places(session)]
    times, found = [], 0
    for place in rows:
        _, agent, index = names.parse_submap(place[0])
        vertex = await session._store.submaps.vertex(session.session, agent, index)
        started = time.perf_counter()
        hits = await session._places.nearest(vertex.descriptor.vector[None], NEIGHBOURS)
        times.append(time.perf_counter() - started)
        found += len({hit.name for hit in hits} & {*place})
    if not rows:
        return {}
    return {"query_ms": spread(times), "of_one_place_found": round(found / len(rows) / EACH, 4)}


async def _names_of_places(session: SessionCoordinator) -> AsyncIterator[list[str]]:
    """The sub-maps of some places, those of each by order of arrival."""
    count = len(session.graph.online)
    for place in np.random.default_rng(0).integers(0, count // EACH, SINGLE if count else 0):
        row, _ = await session._store.submaps.page(
            session.session, after=EACH * int(place), limit=EACH
        )
        yield [one.name for one in row]


def started_alone(options: argparse.Namespace, folder: Path) -> dict:
    """`measure_start` in a process of its own."""
    command = [sys.executable, __file__, str(options.run), "--start", str(folder)]
    command += ["--database", options.database] if options.database else []
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


async def main(options: argparse.Namespace) -> None:
    """One store that grows from size to size."""
    index = "pgvector" if options.database else "faiss"
    config = StoreConfig(database=options.database, index=index)
    if options.start is not None:
        print(json.dumps(await measure_start(options.start, config)))
        return
    headers = await recorded_headers(RunFolder(options.run))
    sizes = [len(header.SerializeToString()) for header in headers]
    print(json.dumps({"recorded": len(headers), "header_bytes_mean": float(np.mean(sizes))}))
    filling = Filling(headers)
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        async with opened(folder, config) as store:
            await filling.register(store)
        empty = started_alone(options, folder)
        print(json.dumps({"empty": empty}), flush=True)
        for size in options.sizes:
            async with opened(folder, config) as store:
                if store.leases is not None:
                    await store.leases.take(filling.session)
                fill_s = await filling.fill(store, size, folder)
                found = {"part": "server", "size": filling.count, "dimension": filling.dimension}
                found["filled_s_per_1000"] = round(fill_s, 2)
                found |= await measure_store(filling, store)
                found["database_mb"] = await database_mb(store, folder)
            if store.leases is not None:  # the first start fills pgvector's table
                found["index_filled_s"] = started_alone(options, folder)["start_wall_s"]
            found |= started_alone(options, folder)
            found["mib"] = round(found["start_peak_mib"] - empty["start_peak_mib"], 1)
            print(json.dumps(found), flush=True)
            if filling.count < size:
                print(json.dumps({"size": size, "limit": "less than 12 GiB free on the disk"}))
                return


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="the folder of a finished `magic run`")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--folder", type=Path, help="where the data are put and removed")
    parser.add_argument("--database", default="", help="an empty one of PostgreSQL, not SQLite")
    parser.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    asyncio.run(main(parser.parse_args()))
