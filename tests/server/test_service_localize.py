"""Localize: an image that nobody stored is placed in the map; one of another place is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import AsyncIterator, Callable

import grpc
import grpc.aio
import numpy as np
import pytest
import pytest_asyncio
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import (
    CorruptData,
    DescriptorModelMismatch,
    InvalidInput,
    MagicError,
    NotFound,
    NotLocalized,
    Overloaded,
)
from magic_core.geometry import se3
from magic_core.submap import Descriptor
from magic_core.wire import error_of, geometry, images
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.localize_config import LocalizeConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from tests.postgresql import NewStore
from tests.small_world import DIMENSION, LARGE, MODEL_ID, look, make_submap, path, render, thumbnail

pytestmark = pytest.mark.asyncio(loop_scope="module")

SUBMAPS = 2


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def mapped(
    tmp_path_factory: pytest.TempPathFactory,
    new_store: NewStore,
    jobs: JobConfig,
) -> AsyncIterator[tuple[Server, MagicClient]]:
    """A server started again on a map that one agent left, and an empty session beside it."""
    config = ServerConfig(
        data_dir=tmp_path_factory.mktemp("localize"),
        store=new_store(),
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        jobs=jobs,
        loops=LoopConfig(enabled=False),
    )
    async with Server(config) as first, MagicClient(first.address) as client:
        await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        for index in range(SUBMAPS):
            await client.submit_submap(make_submap(index=index, camera=LARGE, submaps=SUBMAPS))
        await client.register_agent("empty", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    async with (
        Server(config) as second,
        MagicClient(second.address, ClientConfig(localize_timeout_s=240.0)) as client,
    ):
        assert await (await second.sessions.named("room")).idle(timeout_s=600)
        yield second, client


async def test_a_view_that_nobody_stored_is_placed_in_the_map(mapped) -> None:
    _, client = mapped
    world_from_camera = look(-0.38, -1.08, -0.06, y=0.05)
    colour, depth = render(LARGE, world_from_camera)
    found = await client.localize(
        "room", camera=LARGE, colour=colour, depth=depth, descriptor=thumbnail(colour)
    )
    snapshot = await client.get_corrected_poses("room")
    pose = snapshot.poses[found.submap]
    assert (found.component, found.revision) == (pose.component, snapshot.revision)
    truth = se3.inverse(path(0, SUBMAPS)[0]) @ world_from_camera
    error = se3.inverse(truth) @ found.world_from_camera
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.degrees(se3.rotation_angle(error)) < 0.5
    np.testing.assert_allclose(
        found.world_from_camera, pose.world_from_anchor @ found.anchor_from_camera, atol=1e-9
    )
    assert found.confidence > 0.5
    assert found.similarity > 0.5
    assert 0.5 < found.fitness <= 1.0
    assert np.linalg.eigvalsh(found.information)[0] > 100.0


async def test_a_view_of_another_place_is_refused_with_what_was_tried(mapped) -> None:
    _, client = mapped
    aside, depth = render(LARGE, look(0.0, 0.0, np.pi / 2))
    with pytest.raises(NotLocalized, match="similarity of"):
        await client.localize(
            "room", camera=LARGE, colour=aside, depth=depth, descriptor=thumbnail(aside)
        )
    # Even when its descriptor claims to be a stored place: geometry has the last word.
    liar = make_submap(camera=LARGE, submaps=SUBMAPS).descriptor
    with pytest.raises(NotLocalized, match=r"submaps/0 \([A-Z_]+\)"):
        await client.localize("room", camera=LARGE, colour=aside, depth=depth, descriptor=liar)


async def test_a_session_without_placed_submaps_says_so(mapped) -> None:
    _, client = mapped
    colour, depth = render(LARGE, path(0, SUBMAPS)[0])
    view = {"camera": LARGE, "colour": colour, "depth": depth, "descriptor": thumbnail(colour)}
    with pytest.raises(NotLocalized, match="no placed sub-maps"):
        await client.localize("empty", **view)
    with pytest.raises(NotFound, match="sessions/hall"):
        await client.localize("hall", **view)
    stranger = Descriptor("another-model", thumbnail(colour).vector)
    with pytest.raises(DescriptorModelMismatch):
        await client.localize("room", **(view | {"descriptor": stranger}))


def request() -> mapping_pb.LocalizeRequest:
    """A right one."""
    colour, depth = render(LARGE, path(0, SUBMAPS)[0])
    return mapping_pb.LocalizeRequest(
        session="sessions/room",
        camera=geometry.camera_to_proto(LARGE),
        colour=images.encode_colour_jpeg(colour),
        colour_media_type=images.JPEG,
        depth_png=images.encode_depth_png(depth),
        metres_per_unit=0.001,
        image_descriptor=geometry.descriptor_to_proto(thumbnail(colour)),
    )


def _huge_camera(sent: mapping_pb.LocalizeRequest) -> None:
    sent.camera.width, sent.camera.height = 60_000, 1_000
    sent.camera.fx = sent.camera.fy = 50_000.0


MALFORMED: dict[str, tuple[Callable[[mapping_pb.LocalizeRequest], object], type, str]] = {
    "no session": (lambda r: r.ClearField("session"), InvalidInput, "session"),
    "no camera": (lambda r: r.ClearField("camera"), InvalidInput, "camera.width"),
    "a huge camera": (_huge_camera, InvalidInput, "camera.width"),
    "another media type": (
        lambda r: setattr(r, "colour_media_type", "image/gif"), InvalidInput, "colour_media_type"),
    "no colour": (lambda r: r.ClearField("colour"), CorruptData, "colour"),
    "half a depth image": (
        lambda r: setattr(r, "depth_png", r.depth_png[:500]), CorruptData, "depth_png"),
    "colour as depth": (lambda r: setattr(r, "depth_png", r.colour), CorruptData, "depth_png"),
    "another size": (lambda r: setattr(r.camera, "height", 191), InvalidInput, "colour"),
    "no unit": (lambda r: r.ClearField("metres_per_unit"), InvalidInput, "metres_per_unit"),
    "NaN unit": (
        lambda r: setattr(r, "metres_per_unit", float("nan")), InvalidInput, "metres_per_unit"),
    "no descriptor": (lambda r: r.ClearField("image_descriptor"), InvalidInput, "image_descriptor"),
}  # fmt: skip


@pytest.mark.parametrize("what", MALFORMED)
async def test_a_malformed_request_is_refused_by_its_field(what: str, mapped) -> None:
    server, _ = mapped
    change, kind, field = MALFORMED[what]
    sent = request()
    change(sent)
    error = await refusal_of(server, sent)
    assert type(error) is kind
    assert field in [violation.field for violation in error.violations]


async def refusal_of(server: Server, sent: mapping_pb.LocalizeRequest) -> MagicError:
    async with grpc.aio.insecure_channel(server.address) as channel:
        with pytest.raises(grpc.RpcError) as caught:
            await mapping_grpc.MappingServiceStub(channel).Localize(sent, timeout=60)
    return error_of(caught.value)


async def test_more_images_than_agreed_are_sent_away(mapped) -> None:
    server, _ = mapped
    localizer = server.localizer
    localizer._config = dataclasses.replace(server.config, localize=LocalizeConfig(waiting=1))
    localizer._under_way = 1
    try:
        error = await refusal_of(server, request())
    finally:
        localizer._under_way = 0
        localizer._config = server.config
    assert type(error) is Overloaded
    assert error.retry_after_s
