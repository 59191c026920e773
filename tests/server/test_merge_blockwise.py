"""A merge of several blocks as jobs of their own: resumed, run again, given up."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from magic_agent.client import MagicClient
from magic_core.errors import NotFound
from magic_core.gaussians import GaussianCloud
from magic_server.config import ListenConfig, ServerConfig
from magic_server.globalmap import MergeConfig, PlacedSubmap
from magic_server.globalmap.blocks import Neighbours, places_of, plan_blocks
from magic_server.globalmap.merge import build_global_map
from magic_server.globalmap.parts import Parts
from magic_server.globalmap.rounds import agreed_blocks, refine_alone, refine_beside
from magic_server.jobs import JobConfig
from magic_server.preview_config import PreviewConfig
from magic_server.server import Server
from magic_server.store.bucket import bucket_of, listed, whole
from magic_server.store.bucket_client import client_of
from tests.cluster import running_cluster
from tests.server.test_globalmap_merge import submap
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually

CONFIG = MergeConfig(iterations=20, threads=1, block_views=3, converged=0.0)
SUBMAPS = 4  # of two keyframes each


@pytest.fixture
def server_config(server_config: ServerConfig) -> ServerConfig:
    return dataclasses.replace(server_config, merge=CONFIG, preview=PreviewConfig(enabled=False))


async def submit(client: MagicClient) -> None:
    """Sub-maps that are placed."""
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    for index in range(SUBMAPS):
        await client.submit_submap(make_submap(agent=0, index=index))
    async with asyncio.timeout(300.0):
        while len((await client.get_corrected_poses("room")).poses) < SUBMAPS:  # noqa: ASYNC110
            await asyncio.sleep(0.05)


def jobs_of(server: Server, *, blocks: int = 1000) -> list[str]:
    """The names of the jobs that a server hands over from now on; after `blocks` of them, blocks
    wait for ever."""
    names: list[str] = []
    run = server._jobs.run

    async def noted(function, /, *arguments):
        names.append(function.__name__)
        if names.count("refine_block") > blocks:
            await asyncio.Event().wait()
        return await run(function, *arguments)

    server._jobs.run = noted
    return names


def done_blocks(config: ServerConfig) -> dict[str, object]:
    """The blocks that are done, each with what would be another if it were refined again."""
    place = bucket_of(config.store, config.data_dir)
    if place is not None and config.jobs.executor != "pool":
        client = client_of(place)
        keys = [key for key, _ in listed(client, "jobs/") if key.endswith("/concluded.json")]
        concluded: dict[str, object] = {}
        with contextlib.suppress(NotFound):  # the merge may just have ended
            for key in keys:
                concluded[key.split("/")[-2]] = whole(client, key)
        return concluded
    found: dict[str, object] = {}
    with contextlib.suppress(FileNotFoundError):  # the merge may just have ended
        for file in config.data_dir.glob("**/merge-*/b*-*/block_*.json"):
            found[file.parent.name] = file.stat().st_mtime_ns
    return found


def folders_of_merges(config: ServerConfig) -> list[Path]:
    """Where merges work on the server's disk."""
    folders = (config.data_dir, *config.data_dir.glob("replicas/*"))
    return [path for folder in folders for path in folder.glob("merge-*")]


async def first_block(config: ServerConfig) -> dict[str, object]:
    """The blocks that are done, once one is."""
    async with asyncio.timeout(300.0):
        while not (done := done_blocks(config)):  # noqa: ASYNC110
            await asyncio.sleep(0.01)
    return done


async def watched(
    client: MagicClient, config: ServerConfig, name: str, before: dict[str, object]
) -> None:
    """Wait for a map; no block that is done is refined again."""
    kept = dict(before)
    async with asyncio.timeout(600.0):
        while not (status := await client.get_operation(name)).done:
            for block, written in done_blocks(config).items():
                assert kept.setdefault(block, written) == written
            await asyncio.sleep(0.02)
    assert status.state == "SUCCEEDED", status.error
    assert status.result is not None
    assert len(await client.get_global_map(status.result.name)) == status.result.gaussian_count


def test_blocks_refined_in_any_order_are_the_same_map(tmp_path: Path):
    placed = [submap(0, -0.6, -0.3), submap(1, 0.0, 0.0), submap(2, 0.6, 0.3)]
    blocks = plan_blocks(places_of(placed), most_views=2)
    assert len(blocks) > 1
    found = []
    for folder, order in (("forward", 1), ("backward", -1)):
        parts = Parts(tmp_path / folder, "the same")
        beside = parts.beside("beside")
        numbers = list(range(len(blocks)))[::order]
        for number in numbers:
            refine_alone(
                blocks[number], parts, placed, CONFIG, number=number, until=0.5, progress=silent
            )
        for number in numbers:
            others = Neighbours(blocks).near(number)
            assert others
            around = ((other, parts.cloud(other)) for other in (number, *others))
            refine_beside(
                blocks[number], around, beside, placed, CONFIG,
                number=number, span=(0.5, 1.0), progress=silent,
            )  # fmt: skip
        handed = [g for n in numbers for g in beside.guests(n, owners=range(len(blocks)))]
        assert handed
        made = agreed_blocks(range(len(blocks)), beside.cloud, handed)
        found.append(GaussianCloud.concatenate([cloud for _, cloud in made]))
    assert len(found[0]) == len(found[1])
    np.testing.assert_allclose(found[0].means, found[1].means, atol=1e-5)


def silent(share: float, text: str) -> None:
    """Progress that nobody hears."""


async def test_each_block_is_a_job_and_the_map_is_that_of_one_job(
    server: Server, client: MagicClient
) -> None:
    names = jobs_of(server)
    await submit(client)
    shares: list[float] = []
    info = await client.build_global_map("room", progress=lambda share, stage: shares.append(share))
    assert names.count("plan_merge") == names.count("join_blocks") == 1
    assert names.count("refine_block") == names.count("refine_block_beside") // 2 >= 3
    assert "merge_submaps" not in names
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    cloud = await client.get_global_map(info.name)
    assert len(cloud) == info.gaussian_count
    snapshot = await client.get_corrected_poses("room")
    placed = [
        PlacedSubmap(s, snapshot.poses[s.name].world_from_anchor)
        for s in (make_submap(agent=0, index=index) for index in range(SUBMAPS))
    ]
    whole = build_global_map(placed, CONFIG, progress=silent)
    assert whole.summary.blocks == names.count("refine_block")
    # What is sent is quantised, so that the numbers are near and not equal.
    assert abs(len(cloud) - len(whole.cloud)) < 0.05 * len(cloud)


@pytest.mark.slow
async def test_a_merge_of_one_block_is_one_job(server_config: ServerConfig) -> None:
    config = dataclasses.replace(
        server_config, merge=dataclasses.replace(CONFIG, block_views=2 * SUBMAPS)
    )
    async with Server(config) as server, MagicClient(server.address) as client:
        names = jobs_of(server)
        await submit(client)
        await client.build_global_map("room")
        await client.build_global_map("room", coarse_only=True)
        assert names.count("merge_submaps") == 2
        assert "plan_merge" not in names


@pytest.mark.slow
async def test_a_server_started_again_refines_what_was_not_done(
    server_config: ServerConfig,
) -> None:
    async with Server(server_config) as server, MagicClient(server.address) as client:
        await submit(client)
        jobs_of(server, blocks=1)
        begun = await client.start_global_map("room", request_id="map")
        before = await first_block(server_config)
        assert not (await client.get_operation(begun.name)).done
    async with Server(server_config) as server, MagicClient(server.address) as client:
        await watched(client, server_config, begun.name, before)
    await eventually(lambda: not folders_of_merges(server_config))
    await eventually(lambda: not done_blocks(server_config))


@pytest.mark.slow
async def test_a_worker_that_dies_costs_its_block_alone(
    server: Server, client: MagicClient, server_config: ServerConfig
) -> None:
    if server_config.jobs.executor != "pool":
        pytest.skip("the cluster's tests kill its workers")
    await submit(client)
    begun = await client.start_global_map("room")
    before = await first_block(server_config)
    for worker in list(server._jobs._pool._processes):
        os.kill(worker, signal.SIGKILL)
    await watched(client, server_config, begun.name, before)


@pytest.mark.slow
async def test_on_a_cluster_a_lost_worker_costs_its_block_alone(tmp_path: Path) -> None:
    with running_cluster(tmp_path / "cluster") as cluster:
        for name in ("one", "two"):
            cluster.start_worker(name)
        config = ServerConfig(
            data_dir=tmp_path / "data",
            listen=ListenConfig(port=0),
            jobs=JobConfig(executor="dask", scheduler=cluster.address),
            merge=CONFIG,
            preview=PreviewConfig(enabled=False),
        )
        async with Server(config) as server, MagicClient(server.address) as client:
            names = jobs_of(server)
            await submit(client)
            begun = await client.start_global_map("room")
            before = await first_block(config)
            cluster.kill("one")
            await watched(client, config, begun.name, before)
            assert names.count("refine_block") >= 3


@pytest.mark.slow
async def test_a_session_that_moves_leaves_its_blocks_in_the_bucket(
    server: Server, client: MagicClient, server_config: ServerConfig
) -> None:
    if server_config.jobs.executor == "pool":
        pytest.skip("no bucket to leave blocks in")
    await submit(client)
    run = server._jobs.run
    jobs_of(server, blocks=1)
    begun = await client.start_global_map("room", request_id="map")
    before = await first_block(server_config)
    session = await server._store.agents.session("room")
    await server._maps.hand_on(session.id)
    assert done_blocks(server_config) == before
    assert not folders_of_merges(server_config)
    assert not (await client.get_operation(begun.name)).done
    server._jobs.run = run
    await server._maps.resume(session)  # as the server does that takes it
    await watched(client, server_config, begun.name, before)
    await eventually(lambda: not done_blocks(server_config))


@pytest.mark.slow
async def test_a_deleted_session_ends_its_blocks(
    server: Server, client: MagicClient, server_config: ServerConfig
) -> None:
    names = jobs_of(server)
    await submit(client)
    begun = await client.start_global_map("room")
    async with asyncio.timeout(300.0):
        while "refine_block" not in names:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
    await client.delete_session("room", force=True)
    with pytest.raises(NotFound):
        await client.get_operation(begun.name)
    assert "join_blocks" not in names
