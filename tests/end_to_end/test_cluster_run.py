"""Two Dask workers place a run's sub-maps where the pool does, whoever is killed on the way."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from benchmarks.cluster.replay import difference, replay
from magic_agent.client import MagicClient
from magic_core.wire import EncodedSubmap, encode_submap, names
from magic_server.config import ListenConfig, ServerConfig
from magic_server.coordinator import SessionCoordinator
from magic_server.globalmap import MergeConfig
from magic_server.jobs import JobConfig
from magic_server.posegraph.telling import NOTICEABLE_M
from magic_server.server import Server
from tests.cluster import Cluster, running_cluster
from tests.end_to_end.conftest import Processes
from tests.small_world import DIMENSION, LARGE, MODEL_ID, make_submap
from tests.waiting import eventually

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow

SAME = 1e-6
"""Metres and radians."""
SMALL = ("--submap.frames", "9", "--submap.min-frames", "5", "--merge.iterations", "20")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory):
    """A scheduler and two workers."""
    with running_cluster(tmp_path_factory.mktemp("cluster")) as running:
        for name in ("one", "two"):
            running.start_worker(name)
        yield running


@pytest.fixture(scope="module")
def finished(flat, tmp_path_factory, cluster: Cluster) -> Path:
    """The folder of a `magic run` whose server has the cluster for its jobs."""
    folder = tmp_path_factory.mktemp("run")
    children, out = Processes(folder), folder / "out"
    process = children.start(
        "run", "run", str(flat), "--out", str(out), "--no-report", *SMALL,
        "--jobs.executor", "dask", "--jobs.scheduler", cluster.address,
    )  # fmt: skip
    try:
        process.communicate(timeout=500)
    finally:
        children.stop_all()
    assert process.returncode == 0, children.log("run")
    return out


@pytest.fixture(scope="module")
def recording() -> tuple[dict[str, Any], list[EncodedSubmap]]:
    """What two agents send that walk through a room, in turns."""
    submaps = [
        encode_submap(
            make_submap(agent=agent, index=index, camera=LARGE),
            request_id=f"{agent} {index}",
        )
        for index in range(4)
        for agent in range(2)
    ]
    return {"model_id": MODEL_ID, "dimension": DIMENSION}, submaps


@pytest.fixture(scope="module")
def by_pool(recording, tmp_path_factory) -> dict[str, Any]:
    """What the pool makes of it."""
    model, submaps = recording
    config = config_of(tmp_path_factory.mktemp("pool"), JobConfig())
    return asyncio.run(replay(model, submaps, config))


def config_of(folder: Path, jobs: JobConfig) -> ServerConfig:
    return ServerConfig(data_dir=folder, listen=ListenConfig(port=0), jobs=jobs)


def on(cluster: Cluster) -> JobConfig:
    return JobConfig(executor="dask", scheduler=cluster.address)


def test_a_run_on_the_cluster_makes_a_map(finished: Path) -> None:
    assert (finished / "map.ply").stat().st_size > 10_000


async def test_two_workers_place_the_submaps_where_the_pool_does(
    cluster: Cluster, recording, by_pool, tmp_path: Path
) -> None:
    model, submaps = recording
    made = await replay(model, submaps, config_of(tmp_path, on(cluster)))
    assert_same(made, by_pool)


async def test_killed_workers_and_a_scheduler_change_nothing_but_time(
    cluster: Cluster, recording, by_pool, tmp_path: Path
) -> None:
    model, submaps = recording

    interrupted = []

    async def disturb(number: int, coordinator: SessionCoordinator) -> None:
        if number not in (2, 4, 6):
            return
        await eventually(lambda: coordinator.pending_loops)
        await asyncio.sleep(0.2)
        if number == 2:
            cluster.kill("one")
        if number == 4:
            cluster.start_worker("three", wait=False)
            cluster.kill("two")
        if number == 6:
            cluster.kill("scheduler")
            cluster.start_scheduler()
        interrupted.append(coordinator.pending_loops)

    made = await replay(model, submaps, config_of(tmp_path, on(cluster)), on_submap=disturb)
    assert len(interrupted) == 3
    assert all(interrupted)  # verifications were under way each time
    assert_same(made, by_pool)


async def test_a_merge_goes_on_at_another_worker_and_its_progress_is_told(
    cluster: Cluster, recording, tmp_path: Path
) -> None:
    model, submaps = recording
    for name in list(cluster.workers):
        cluster.kill(name)
    cluster.start_worker("four")
    config = ServerConfig(
        data_dir=tmp_path,
        listen=ListenConfig(port=0),
        jobs=on(cluster),
        merge=MergeConfig(iterations=300, fill=False),
    )
    shares, tries = set(), set()
    async with Server(config) as server, MagicClient(server.address) as client:
        session = await sent(client, model, submaps[:4])
        operation = await client.start_global_map(session)
        async with asyncio.timeout(400.0):
            while not operation.done:
                await asyncio.sleep(0.2)
                operation = await client.get_operation(operation.name)
                shares.add(operation.progress)
                tries |= begun(tmp_path)
                if "four" in cluster.workers and operation.progress > 0.1:
                    cluster.start_worker("five", wait=False)
                    cluster.kill("four")
        assert operation.error is None
        assert operation.result is not None
        assert len(await client.get_global_map(operation.result.name)) > 1000
    assert len(tries) == 2
    assert len(shares - {0.0, 1.0}) > 2


def begun(folder: Path) -> set[str]:
    """The try that a merge in a data folder is at."""
    return {mark.read_text() for mark in folder.glob("merge-*/attempt")}


async def sent(client: MagicClient, model: dict[str, Any], submaps: list[EncodedSubmap]) -> str:
    """Send sub-maps to a new session; its name."""
    for encoded in submaps:
        session, agent, _ = names.parse_submap(encoded.header.name)
        await client.register_agent(session, agent, **model)
        await client.submit_encoded(encoded)
    return session


def assert_same(one: dict[str, Any], other: dict[str, Any]) -> None:
    """The same verdicts, the same poses of the whole graph, and as near as two replays by the pool
    where each step was published as it came."""
    assert one["verdicts"] == other["verdicts"]
    assert "ACCEPTED" in one["verdicts"].values()
    bounds = {"loops": SAME, "solved": SAME, "published": 2.0 * NOTICEABLE_M}
    for kind, bound in bounds.items():
        apart = difference(one[kind], other[kind])
        assert apart["translation_m"] <= bound, kind
        assert apart["rotation_rad"] <= bound, kind
