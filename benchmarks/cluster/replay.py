"""The sub-maps of a finished run, sent again in the same order: where does an engine put them?

Agents that track at the same time never send their sub-maps in quite the same order twice, and the
order decides which pairs are compared. So two engines are compared on a replay: each sub-map is
sent once everything that followed from the one before is settled. Even then the published poses of
one engine differ between two replays, by up to 1e-5 m: verdicts arrive in turns, and a pose that
would move by less is not news (`NOTICEABLE_M`). What does not depend on the order is compared
exactly: every verdict, and the whole graph as it stands in the end, solved by the engine once more.

Examples:
  magic run DATASET --out runs/office
  python benchmarks/cluster/replay.py runs/office --out pool.npz
  dask scheduler --port 8786 &
  magic worker tcp://127.0.0.1:8786 &
  magic worker tcp://127.0.0.1:8786 &
  python benchmarks/cluster/replay.py runs/office --out dask.npz --scheduler tcp://127.0.0.1:8786 \\
      --compare pool.npz
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from magic_agent.client import MagicClient
from magic_core.wire import EncodedSubmap, names
from magic_server.config import ListenConfig, ServerConfig
from magic_server.coordinator import SessionCoordinator
from magic_server.graph import SessionGraph
from magic_server.jobs import JobConfig, new_executor
from magic_server.jobs.tasks import solve_pose_graph
from magic_server.registration import RegistrationConfig
from magic_server.server import Server
from magic_server.store import Store

SETTLED_TIMEOUT_S = 900.0
OnSubmap = Callable[[int, SessionCoordinator], Awaitable[None]]


async def recorded(server_folder: Path) -> tuple[dict[str, Any], list[EncodedSubmap]]:
    """How agents register, and the sub-maps of a run's session in the order of their arrival."""
    config = ServerConfig(data_dir=server_folder, listen=ListenConfig(port=0))
    async with Server(config) as server, MagicClient(server.address) as client:
        (session,) = await client.list_sessions()
        model = {"model_id": session.descriptor_model_id, "dimension": session.descriptor_dimension}
        found = await client.list_submaps(session.name.rpartition("/")[2])
        in_order = sorted(found, key=lambda submap: (submap.received_at, submap.name))
        return model, [await client.download_encoded(submap.name) for submap in in_order]


async def _nothing(_: int, __: SessionCoordinator) -> None:
    pass


async def replay(
    model: dict[str, Any],
    submaps: list[EncodedSubmap],
    config: ServerConfig,
    *,
    on_submap: OnSubmap = _nothing,
) -> dict[str, Any]:
    """What the engine made of the sub-maps, and how long it took.

    `published` and `solved`: world_from_anchor (4, 4) of every sub-map, as the server last told it
    and as a solve of the whole graph gives it; `verdicts` of every pair of sub-maps, and `loops`:
    target_from_source (4, 4) of those that were accepted.

    `on_submap` hears the number of each sub-map when it has been sent, before it is settled, and
    who settles it.
    """
    started = time.perf_counter()
    async with Server(config) as server, MagicClient(server.address) as client:
        registered = set()
        for number, encoded in enumerate(submaps):
            session, agent, _ = names.parse_submap(encoded.header.name)
            if agent not in registered:
                await client.register_agent(session, agent, **model)
                registered.add(agent)
            await client.submit_encoded(encoded)
            coordinator = await server.sessions.named(session)
            await on_submap(number, coordinator)
            if not await coordinator.idle(SETTLED_TIMEOUT_S):
                raise TimeoutError(f"{encoded.header.name} was not settled in time")
        poses = (await client.get_corrected_poses(session)).poses
        found = (await client.list_loops(session)).candidates
    seconds = time.perf_counter() - started
    return {
        "published": {name: pose.world_from_anchor for name, pose in poses.items()},
        "solved": await _solved(config),
        "verdicts": {f"{loop.source} {loop.target}": loop.verdict for loop in found},
        "loops": {
            f"{loop.source} {loop.target}": loop.target_from_source
            for loop in found
            if loop.target_from_source is not None
        },
        "seconds": seconds,
    }


async def _solved(config: ServerConfig) -> dict[str, np.ndarray]:
    """The poses of a stored session's graph, put together in a fixed order and solved as a job."""
    ignore = {"trace": config.tracing, "observer": lambda *_: None}
    jobs = new_executor(config.jobs, folder=config.data_dir, **ignore)
    with ThreadPoolExecutor() as threads:
        async with Store(config.data_dir, threads) as store:
            (session,) = await store.agents.sessions()
            graph = SessionGraph(session.name, config.posegraph)
            async for vertices in store.submaps.pages(session):
                for vertex in vertices:
                    graph.add_vertex(vertex)
            loops = [loop async for page in store.loops.pages(session) for loop in page]
            for loop in sorted(loops, key=lambda loop: (loop.source, loop.target)):
                graph.set_loop(loop)
            while graph.has_news:
                graph.advance(None)
            await jobs.start()
            try:
                solution = await jobs.run(solve_pose_graph, graph.online.arrays(), config.posegraph)
            finally:
                await jobs.close()
    return dict(zip(graph.online.names, solution.poses, strict=True))


def difference(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, float]:
    """The largest differences of two sets of transforms of the same names."""
    if one.keys() != other.keys():
        raise ValueError(f"in one alone: {sorted(one.keys() ^ other.keys())}")
    relative = [np.linalg.inv(one[name]) @ other[name] for name in one]
    skew = [0.5 * (r[:3, :3] - r[:3, :3].T) for r in relative]  # its norm is exact near 0
    return {
        "translation_m": max(float(np.linalg.norm(r[:3, 3])) for r in relative),
        "rotation_rad": max(float(np.linalg.norm(s) / np.sqrt(2.0)) for s in skew),
    }


def main() -> None:
    """Replay a run and print what came of it as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="run folder of `magic run`")
    parser.add_argument("--scheduler", default="", help="of a Dask cluster; default: the pool")
    parser.add_argument("--data-dir", type=Path, help="of the new server; default: a temporary one")
    parser.add_argument("--submaps", type=int, help="replay only the first so many")
    parser.add_argument(
        "--methods", nargs="+", default=RegistrationConfig().methods, help="of registration"
    )
    parser.add_argument("--out", type=Path, required=True, help="file for the poses, .npz")
    parser.add_argument("--compare", type=Path, help="poses of another replay")
    options = parser.parse_args()
    jobs = JobConfig()
    if options.scheduler:
        jobs = JobConfig(executor="dask", scheduler=options.scheduler)
    with tempfile.TemporaryDirectory() as scratch:
        config = ServerConfig(
            data_dir=options.data_dir or Path(scratch),
            listen=ListenConfig(port=0),
            jobs=jobs,
            registration=RegistrationConfig(methods=tuple(options.methods)),
        )
        made = asyncio.run(_main(options.run, config, options.submaps))
    kinds = ("published", "solved", "loops")
    np.savez(options.out, **{f"{kind} {k}": v for kind in kinds for k, v in made[kind].items()})
    verdicts = list(made["verdicts"].values())
    report = {
        "submaps": len(made["published"]),
        "loops": {verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))},
        "seconds": round(made["seconds"], 1),
    }
    if options.compare:
        with np.load(options.compare) as file:
            for kind in kinds:
                part = {k.removeprefix(f"{kind} "): file[k] for k in file if k.startswith(kind)}
                report[f"{kind} differ by"] = difference(made[kind], part)
    print(json.dumps(report))


async def _main(run: Path, config: ServerConfig, count: int | None) -> dict[str, Any]:
    model, submaps = await recorded(run / "server")
    return await replay(model, submaps[:count], config)


if __name__ == "__main__":
    main()
