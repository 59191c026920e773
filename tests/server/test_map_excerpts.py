"""Parts of maps: a region, a level of detail, in every format, of finished maps and previews."""

from __future__ import annotations

import asyncio
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from magicslam.v1 import global_map_service_pb2 as map_pb

from magic_agent.client import MagicClient
from magic_core.errors import DeadlineExceeded, InvalidInput, NotFound, NotSupported, Overloaded
from magic_core.gaussians import GaussianCloud, codec
from magic_core.gaussians.ply import read_ply
from magic_core.gaussians.region import Region
from magic_core.wire import MAX_CHUNK_BYTES
from magic_server.excerpt_config import ExcerptConfig
from magic_server.excerpts import ExcerptKey, Excerpts
from magic_server.preview_config import PreviewConfig
from magic_server.server import Server
from tests.server.test_preview import PREVIEW
from tests.small_world import DIMENSION, MODEL_ID, make_submap

INF = float("inf")
LEFT = Region((-INF, -INF, -INF), (0.0, INF, INF))


@pytest.fixture
def server_config(server_config):
    return dataclasses.replace(
        server_config,
        excerpts=ExcerptConfig(most=3, kept_bytes=1 << 20),
        preview=PreviewConfig(enabled=False),  # made once: no other takes its place meanwhile
    )


@pytest.fixture
async def placed(client: MagicClient) -> MagicClient:
    """A client of a server with two placed sub-maps, which waits as often as it is asked to."""
    client.config = dataclasses.replace(client.config, attempts=1000)
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    for index in range(2):
        await client.submit_submap(make_submap(agent=0, index=index))
    async with asyncio.timeout(300.0):
        while len((await client.get_corrected_poses("room")).poses) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.05)
    return client


def folders_of(server: Server) -> list[Path]:
    return list(server.config.data_dir.glob("**/excerpts/*"))


def decoded(kind: str, data: bytes, folder: Path) -> GaussianCloud:
    if kind != "ply":
        return codec.decode(data)
    (folder / "part.ply").write_bytes(data)
    return read_ply(folder / "part.ply")


async def test_a_part_of_a_map_in_every_format(placed: MagicClient, tmp_path: Path) -> None:
    # Of the preview before anything is merged, and of the map afterwards.
    for built in (False, True):
        if built:
            await placed.build_global_map("room", coarse_only=True)
        whole = await placed.get_global_map("sessions/room")
        inside = whole.select(LEFT.holds(whole.means))
        assert 0 < len(inside) < len(whole)
        for kind in ("ply", "lossless", "compact"):
            info, data = await placed.download_global_map("sessions/room", format=kind, region=LEFT)
            assert info.part.region == LEFT
            assert info.part.gaussian_count == info.part.full_gaussian_count == len(inside)
            assert info.gaussian_count == len(whole)
            cloud = decoded(kind, data, tmp_path)
            assert len(cloud) == len(inside)
            for found, wanted in zip(cloud.means.T, inside.means.T, strict=True):
                np.testing.assert_allclose(np.sort(found), np.sort(wanted), atol=6e-4)
            count = len(inside) // 3
            info, data = await placed.download_global_map(
                "sessions/room", format=kind, region=LEFT, max_gaussians=count
            )
            part = info.part
            assert (part.max_gaussians, part.gaussian_count) == (count, count)
            assert part.full_gaussian_count == len(inside)
            assert len(decoded(kind, data, tmp_path)) == count
            again = await placed.download_global_map(
                "sessions/room", format=kind, region=LEFT, max_gaussians=count
            )
            assert again[1] == data  # the same part is the same file, also once it was dropped
        fewer = await placed.get_global_map("sessions/room", max_gaussians=100)
        assert len(fewer) == 100
        # Enough for all of it is all of it, bit for bit.
        info, data = await placed.download_global_map(
            "sessions/room", format="lossless", max_gaussians=10**12
        )
        assert np.array_equal(codec.decode(data).means, whole.means)
        assert info.part.gaussian_count == len(whole)


async def test_a_region_without_gaussians_is_an_empty_file(
    placed: MagicClient, tmp_path: Path
) -> None:
    nowhere = Region((1e6, 1e6, 1e6), (2e6, 2e6, 2e6))
    for kind in ("ply", "lossless", "compact"):
        info, data = await placed.download_global_map(
            PREVIEW, format=kind, region=nowhere, max_gaussians=5
        )
        assert (info.part.gaussian_count, info.part.full_gaussian_count) == (0, 0)
        assert len(decoded(kind, data, tmp_path)) == 0


async def test_hostile_values_are_refused_and_make_nothing(
    placed: MagicClient, server: Server
) -> None:
    nan = float("nan")
    for region, field in (
        (map_pb.Region(), "x"),
        (map_pb.Region(high_x=1.0, high_y=nan, high_z=1.0), "y"),
        (map_pb.Region(high_x=1.0, high_y=1.0, low_z=3.0, high_z=1.0), "z"),
        (map_pb.Region(low_x=INF, high_x=INF, high_y=1.0, high_z=1.0), "x"),
    ):
        request = map_pb.GetGlobalMapRequest(name=PREVIEW, region=region)

        async def first_message(request=request) -> None:
            async for _ in placed.map_stub.GetGlobalMap(request, timeout=60.0):
                return

        with pytest.raises(InvalidInput, match="lowest") as caught:
            await placed.retried(first_message)
        assert [v.field for v in caught.value.violations] == [f"region.low.{field}"]
    for count in (-1, 1 << 64):
        with pytest.raises(InvalidInput, match="max_gaussians"):
            await placed.get_global_map(PREVIEW, max_gaussians=count)
    with pytest.raises(NotFound):
        await placed.get_global_map("sessions/room/maps/77", region=LEFT)
    assert not folders_of(server)


async def test_files_are_bounded_and_go_with_what_they_show(
    placed: MagicClient, server: Server
) -> None:
    if server.config.store.blobs:
        pytest.skip("the files are in the bucket")
    counts = range(10, 16)
    found = await asyncio.gather(
        *(placed.get_global_map(PREVIEW, max_gaussians=count) for count in counts)
    )
    # Further ones than three waited for their turn, as the server asked them to.
    assert [len(cloud) for cloud in found] == list(counts)
    assert 0 < len(folders_of(server)) <= 3
    await placed.delete_submap("sessions/room/agents/agent_0/submaps/1", force=True)
    assert not folders_of(server)
    left = await placed.get_global_map(PREVIEW, max_gaussians=10**9)
    assert len(left) == len(make_submap(agent=0, index=0).gaussians)


async def test_whoever_stops_reading_gives_up_the_place(
    placed: MagicClient, server: Server
) -> None:
    excerpts: Excerpts = server._excerpts
    patient = excerpts._config
    excerpts._config = dataclasses.replace(patient, idle_s=0.5)
    key, source = await preview_key(server, count=500)
    async with excerpts.opened(key, source) as (made, chunks):
        assert made.gaussian_count == 500
        first = await anext(chunks)
        assert len(first.data) == min(made.length, MAX_CHUNK_BYTES)
        async with asyncio.timeout(60.0):
            while excerpts._entries[key].users:  # noqa: ASYNC110
                await asyncio.sleep(0.02)
        with pytest.raises(DeadlineExceeded, match="took nothing"):
            await anext(chunks)
    excerpts._config = patient
    assert len(await placed.get_global_map(PREVIEW, max_gaussians=500)) == 500


async def test_while_all_places_are_in_use_others_are_asked_to_wait(
    placed: MagicClient, server: Server
) -> None:
    excerpts: Excerpts = server._excerpts
    keys = [await preview_key(server, count=count) for count in (5, 6, 7, 8)]
    async with (
        excerpts.opened(*keys[0]),
        excerpts.opened(*keys[1]),
        excerpts.opened(*keys[2]),
    ):
        with pytest.raises(Overloaded, match="try again") as caught:
            async with excerpts.opened(*keys[3]):
                pass
        assert caught.value.retry_after_s
        async with excerpts.opened(*keys[1]) as (made, _):  # the same part needs no place
            assert made.gaussian_count == 6
    async with excerpts.opened(*keys[3]) as (made, _):
        assert made.gaussian_count == 8


async def test_a_part_is_made_to_its_end_when_nobody_waits_any_more(
    placed: MagicClient, server: Server
) -> None:
    # A worker does not stop, so that its file must not be forgotten.
    excerpts: Excerpts = server._excerpts
    (key, source), (other, _) = [await preview_key(server, count=count) for count in (50, 51)]
    run = server._jobs.run
    begun: list[str] = []
    ended: list[str] = []
    go = asyncio.Event()

    async def held_up(function, /, *arguments):
        begun.append(function.__name__)
        await go.wait()
        try:
            return await run(function, *arguments)
        finally:
            ended.append(function.__name__)

    async def asked(key: ExcerptKey) -> int:
        async with excerpts.opened(key, source) as (made, _):
            return made.gaussian_count

    async def given_up(key: ExcerptKey) -> None:
        before = len(begun)
        asking = asyncio.create_task(asked(key))
        async with asyncio.timeout(60.0):
            while len(begun) == before:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)

    server._jobs.run = held_up
    await given_up(key)
    again = asyncio.create_task(asked(key))  # waits for what is being made
    await given_up(other)
    await excerpts.forget(other.session)  # as when the session is deleted
    go.set()
    assert await again == 50
    async with asyncio.timeout(300.0):
        while len(ended) < 2 or folders_of(server):  # noqa: ASYNC110
            await asyncio.sleep(0.02)
    assert begun == ["make_excerpt"] * 2


async def preview_key(server: Server, *, count: int) -> tuple[ExcerptKey, object]:
    """A level of detail of the preview."""
    row = await server._store.agents.session("room")
    async with server._previews.held("room") as (_, source):
        return ExcerptKey(row.id, source.sha256, "lossless", None, count), source


async def test_an_older_server_that_knows_whole_maps_only_is_told_apart(
    placed: MagicClient,
) -> None:
    newer = placed.map_stub.GetGlobalMap

    async def older(request: map_pb.GetGlobalMapRequest, *, timeout: float):  # noqa: ASYNC109
        plain = map_pb.GetGlobalMapRequest(name=request.name, format=request.format)
        async for message in newer(plain, timeout=timeout):
            if message.HasField("header"):
                message.header.ClearField("part")
            yield message

    placed.map_stub.GetGlobalMap = older
    info, _ = await placed.download_global_map(PREVIEW)
    assert info.part.gaussian_count == info.gaussian_count
    await placed.get_global_map(PREVIEW, max_gaussians=10**9)
    for part in ({"region": LEFT}, {"max_gaussians": 3}):
        with pytest.raises(NotSupported, match="whole maps only"):
            await placed.get_global_map(PREVIEW, **part)
