"""Places found by keyframes: two sub-maps that begin in different directions and end in one.

The agents stand in one room. One looks ahead first and the other back, so that their anchors share
nothing; both turn until they look at the same wall.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from magic_agent.client import ClientConfig, MagicClient
from magic_agent.places import DescriptorModel, load_descriptor_model
from magic_agent.places.keyframes import with_described_keyframes
from magic_core.data import open_dataset
from magic_core.errors import NotLocalized
from magic_core.geometry import se3
from magic_core.submap import Keyframe, Submap, TrackedFrame
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from tests.postgresql import NewStore
from tests.small_world import LARGE, gaussians_of, look, make_submap, render


@functools.cache
def model() -> DescriptorModel:
    return load_descriptor_model()


MIN_SIMILARITY = 0.8
"""Walls of the room look alike: 0.72 at most where they are not the same, 0.92 where they are."""
TURNS = {
    "ahead": [look(-0.3, -0.3, np.radians(yaw)) for yaw in (0, 45, 90)],
    "back": [look(-0.25, -0.35, np.radians(yaw)) for yaw in (180, 135, 93)],
}


def turning(agent: str, *, described: int) -> Submap:
    """A sub-map of an agent that turns where it stands."""
    poses = TURNS[agent]
    anchor_from_camera = [se3.inverse(poses[0]) @ pose for pose in poses]
    images = [render(LARGE, pose) for pose in poses]
    submap = dataclasses.replace(
        make_submap(camera=LARGE, frames=3),
        agent=agent,
        gaussians=gaussians_of(LARGE, *images[0]),
        keyframes=tuple(
            Keyframe(n, 0.1 * n, anchor_from_camera[n], *image) for n, image in enumerate(images)
        ),
        trajectory=tuple(TrackedFrame(n, 0.1 * n, at) for n, at in enumerate(anchor_from_camera)),
        descriptor=model().describe(images[0][0]),
    )
    return with_described_keyframes(submap, model().describe, count=described)


@asynccontextmanager
async def serving(config: ServerConfig) -> AsyncIterator[tuple[Server, MagicClient]]:
    async with (
        Server(config) as server,
        MagicClient(server.address, ClientConfig(localize_timeout_s=240.0)) as client,
    ):
        yield server, client


async def submitted(
    server: Server, client: MagicClient, submaps: Sequence[Submap]
) -> list[tuple[str, str]]:
    """Send sub-maps, wait until they are joined; the verdict and reason of every candidate."""
    for submap in submaps:
        encoder = {"model_id": model().model_id, "dimension": model().dimension}
        await client.register_agent(submap.session, submap.agent, **encoder)
        await client.submit_submap(submap)
    assert await (await server.sessions.named("room")).idle(timeout_s=600)
    loops = (await client.list_loops("room")).candidates
    return [(loop.verdict, loop.reason) for loop in loops]


@pytest.fixture
def config(tmp_path: Path, new_store: NewStore, jobs: JobConfig) -> ServerConfig:
    return ServerConfig(
        data_dir=tmp_path,
        store=new_store(),
        listen=ListenConfig(port=0, stop_grace_s=600.0),
        jobs=jobs,
        loops=LoopConfig(min_similarity=MIN_SIMILARITY),
    )


async def test_without_descriptors_of_keyframes_the_place_is_not_found(
    config: ServerConfig,
) -> None:
    async with serving(config) as (server, client):
        both = [turning(agent, described=0) for agent in TURNS]
        assert await submitted(server, client, both) == []
        assert len((await client.get_corrected_poses("room")).components) == 2


async def test_keyframes_find_the_place_and_the_loop_joins_the_anchors(
    config: ServerConfig,
) -> None:
    ahead, back = (turning(agent, described=2) for agent in TURNS)
    async with serving(config) as (server, client):
        assert await submitted(server, client, [ahead, back]) == [("ACCEPTED", "ACCEPTED")]
        (loop,) = (await client.list_loops("room")).candidates
        assert (loop.source, loop.target) == (back.name, ahead.name)
        assert (loop.source_keyframe, loop.target_keyframe) == (2, 2)
        assert loop.target_from_source is not None
        truth = se3.inverse(TURNS["ahead"][0]) @ TURNS["back"][0]
        miss = se3.inverse(truth) @ loop.target_from_source
        assert np.linalg.norm(miss[:3, 3]) < 0.03
        assert np.degrees(se3.rotation_angle(se3.orthonormalised(miss))) < 1.0
        assert len((await client.get_corrected_poses("room")).components) == 1
    # All of it is there after a restart, and is gone with the sub-map.
    view, depth = render(LARGE, look(-0.27, -0.32, np.radians(91)))
    seen = model().describe(view)
    query = {"camera": LARGE, "colour": view, "depth": depth, "descriptor": seen}
    async with serving(config) as (server, client):
        nearest = (await client.query_loops(seen, session="room")).candidates
        assert {found.target for found in nearest} == {ahead.name, back.name}
        assert [found.target_keyframe for found in nearest] == [2, 2]
        assert min(found.similarity for found in nearest) > MIN_SIMILARITY
        found = await client.localize("room", **query)
        poses = (await client.get_corrected_poses("room")).poses
        placed = poses[ahead.name].world_from_anchor
        assert pose_error(found.world_from_camera, placed) < 0.03
        for submap in (ahead, back):
            await client.delete_submap(submap.name, force=True)
        assert (await client.query_loops(seen, session="room")).candidates == ()
        with pytest.raises(NotLocalized):
            await client.localize("room", **query)


DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "living_room_3agents"
RECORDED = {"agent_0": 0, "agent_1": 255}
"""First frames of two pieces of the living room: their anchors share nothing and are less alike
than the encoder's threshold; 30 frames later both look at the same."""


def recorded(agent: str, *, described: int) -> tuple[Submap, np.ndarray]:
    """45 frames of a recording as a sub-map at its true poses, and world_from_anchor."""
    source = next(one for one in open_dataset(DATA, scale=0.5) if one.name == agent)
    frames = [source[RECORDED[agent] + step] for step in range(0, 45, 5)]
    poses = [frame.world_from_camera for frame in frames]
    assert poses[0] is not None
    anchor_from_world = se3.inverse(poses[0])
    keyframes = tuple(
        Keyframe(n, frame.timestamp_s, anchor_from_world @ pose, frame.colour, frame.depth)
        for n, (frame, pose) in enumerate(zip(frames, poses, strict=True))
    )
    submap = dataclasses.replace(
        make_submap(),
        agent=agent,
        camera=source.camera,
        keyframes=keyframes,
        trajectory=tuple(
            TrackedFrame(one.frame_index, one.timestamp_s, one.anchor_from_camera)
            for one in keyframes
        ),
        descriptor=model().describe(frames[0].colour),
    )
    return with_described_keyframes(submap, model().describe, count=described), poses[0]


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="shared data is absent")
@pytest.mark.parametrize("described", [0, 4])
async def test_in_a_real_room_keyframes_find_what_anchors_do_not_see(
    described: int, config: ServerConfig
) -> None:
    config = dataclasses.replace(config, loops=LoopConfig())
    (first, world_from_first), (second, world_from_second) = (
        recorded(agent, described=described) for agent in RECORDED
    )
    async with serving(config) as (server, client):
        found = await submitted(server, client, [first, second])
        components = (await client.get_corrected_poses("room")).components
        if not described:
            assert found == []
            assert len(components) == 2
            return
        assert found == [("ACCEPTED", "ACCEPTED")]
        assert len(components) == 1
        (loop,) = (await client.list_loops("room")).candidates
    assert loop.source_keyframe > 0
    assert loop.target_keyframe > 0
    assert loop.target_from_source is not None
    truth = se3.inverse(world_from_first) @ world_from_second
    miss = se3.inverse(truth) @ loop.target_from_source
    # The anchors look 89 degrees apart; measured 1.2 mm and 0.03 degrees.
    assert np.linalg.norm(miss[:3, 3]) < 0.02
    assert np.degrees(se3.rotation_angle(se3.orthonormalised(miss))) < 0.5


def pose_error(world_from_camera: np.ndarray, world_from_ahead: np.ndarray) -> float:
    """Metres from where the image was taken, by the sub-map `ahead`."""
    truth = se3.inverse(TURNS["ahead"][0]) @ look(-0.27, -0.32, np.radians(91))
    miss = se3.inverse(world_from_ahead @ truth) @ world_from_camera
    return float(np.linalg.norm(miss[:3, 3]))
