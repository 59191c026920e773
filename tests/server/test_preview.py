"""The preview of a session in progress: there before any merge, and where the pose graph says."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from magic_agent.client import MagicClient
from magic_core.errors import NotFound
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.ply import read_ply
from magic_core.submap import Submap
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.preview_config import PreviewConfig
from magic_server.server import Server
from magic_server.store_config import StoreConfig
from tests.postgresql import NewStore
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_previews

PREVIEW = "sessions/room/maps/preview"


def config_of(folder, store: StoreConfig, jobs: JobConfig, **preview) -> ServerConfig:
    return ServerConfig(
        data_dir=folder,
        store=store,
        listen=ListenConfig(port=0, stop_grace_s=1.0),
        jobs=jobs,
        preview=PreviewConfig(**preview),
    )


def expected_cloud(snapshot, submaps) -> GaussianCloud:
    """The sub-maps as they were sent, where the server says they are."""
    return GaussianCloud.concatenate(
        [s.gaussians.transformed(snapshot.poses[s.name].world_from_anchor) for s in submaps]
    )


def assert_same_places(found: GaussianCloud, expected: GaussianCloud) -> None:
    assert len(found) == len(expected)
    for cloud_axis, expected_axis in zip(found.means.T, expected.means.T, strict=True):
        np.testing.assert_allclose(np.sort(cloud_axis), np.sort(expected_axis), atol=6e-4)


async def test_the_preview_is_there_before_any_merge_and_follows(
    tmp_path, new_store: NewStore, jobs: JobConfig
):
    submaps = [make_submap(agent=0, index=i) for i in range(3)]
    server_config = config_of(tmp_path, new_store(), jobs, interval_s=0.1)
    async with Server(server_config) as server, MagicClient(server.address) as client:
        await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        with pytest.raises(NotFound, match="nothing to show"):
            await client.get_global_map("sessions/room")
        await client.submit_submap(submaps[0])
        await client.get_corrected_poses("room")
        info, _ = await placed(client, 1)
        for submap in submaps[1:]:
            await client.submit_submap(submap)
        await placed(client, 3)
        snapshot, info = await caught_up(client)
        cloud = await client.get_global_map(PREVIEW)
        assert info.name == PREVIEW
        assert info.submaps == tuple(s.name for s in submaps)
        assert info.gaussian_count == len(cloud)
        assert_same_places(cloud, expected_cloud(snapshot, submaps))
        assert not await client.list_operations("room")

        # Any format, and the plain session's name too, while nothing is merged.
        _, ply = await client.download_global_map("sessions/room", format="ply")
        (tmp_path / "p.ply").write_bytes(ply)
        assert len(read_ply(tmp_path / "p.ply")) == len(cloud)
        await eventually(_only_one(server_config))  # older ones are gone

        # What is deleted is not shown any more, even before the next preview is made.
        await client.delete_submap(submaps[2].name, force=True)
        info, cloud = await placed(client, 2)
        assert len(cloud) == sum(len(s.gaussians) for s in submaps[:2])

        merged = await client.build_global_map("room", coarse_only=True)
        newest, _ = await client.download_global_map("sessions/room")
        assert newest.name == merged.name


def _only_one(config: ServerConfig):
    async def only_one() -> bool:
        return await asyncio.to_thread(stored_previews, config) == 1

    return only_one


async def eventually(condition) -> None:
    """Return once an awaited condition holds."""
    async with asyncio.timeout(600.0):  # a worker starts first
        while not await condition():  # noqa: ASYNC110  # the state is the server's
            await asyncio.sleep(0.05)


async def caught_up(client: MagicClient):
    """The newest poses, and the preview once it shows them."""

    found = []

    async def equal() -> bool:
        info, _ = await client.download_global_map(PREVIEW, format="lossless")
        snapshot = await client.get_corrected_poses("room")
        found[:] = [snapshot, info]  # while both grow they are equal for a moment only
        return info.revision == snapshot.revision

    await eventually(equal)
    return found


async def placed(client: MagicClient, count: int):
    """The preview, once it holds so many sub-maps."""

    async def complete() -> bool:
        try:
            info, _ = await client.download_global_map(PREVIEW, format="lossless")
        except NotFound:
            return False
        return len(info.submaps) == count

    await eventually(complete)
    info, _ = await client.download_global_map(PREVIEW, format="lossless")
    return info, await client.get_global_map(PREVIEW)


async def one_placed(client: MagicClient) -> Submap:
    """A sub-map that the pose graph has placed."""
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    submap = make_submap(agent=0, index=0)
    await client.submit_submap(submap)

    async def is_placed() -> bool:
        return bool((await client.get_corrected_poses("room")).poses)

    await eventually(is_placed)
    return submap


async def test_without_following_it_is_made_when_asked_for(
    tmp_path, new_store: NewStore, jobs: JobConfig
):
    server_config = config_of(tmp_path, new_store(), jobs, enabled=False)
    async with Server(server_config) as server, MagicClient(server.address) as client:
        submap = await one_placed(client)
        await asyncio.sleep(0)
        assert not (tmp_path / "previews").exists()
        assert len(await client.get_global_map(PREVIEW)) == len(submap.gaussians)
        with pytest.raises(NotFound):
            await client.get_global_map("sessions/nowhere/maps/preview")


async def test_a_preview_whose_asker_leaves_is_made_and_kept(
    tmp_path, new_store: NewStore, jobs: JobConfig
):
    server_config = config_of(tmp_path, new_store(), jobs, enabled=False)
    async with Server(server_config) as server, MagicClient(server.address) as client:
        submap = await one_placed(client)
        begun, go_on, run, count = asyncio.Event(), asyncio.Event(), server._jobs.run, 0

        async def held_up(function, /, *arguments):
            nonlocal count
            count += 1
            begun.set()
            await go_on.wait()
            return await run(function, *arguments)

        server._jobs.run = held_up
        asking = asyncio.create_task(client.get_global_map(PREVIEW))
        await begun.wait()
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        go_on.set()
        await eventually(_only_one(server_config))
        assert len(await client.get_global_map(PREVIEW)) == len(submap.gaussians)
        assert count == 1
        assert await _only_one(server_config)()
