"""Which keyframes an agent describes: few, spread over what the sub-map shows, beside tracking."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from magic_agent.agent import Agent
from magic_agent.client import MagicClient
from magic_agent.config import AgentConfig
from magic_agent.mapping import MappingConfig
from magic_agent.places.keyframes import spread_keyframes, with_described_keyframes
from magic_agent.slam_config import SubmapConfig
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.geometry import se3
from magic_core.submap import Descriptor, Keyframe
from tests.small_world import DIMENSION, LARGE, MODEL_ID, look, make_submap, render, thumbnail


def keyframes_at(*poses: np.ndarray) -> list[Keyframe]:
    anchor_from_world = se3.inverse(poses[0])
    return [
        Keyframe(n, 0.1 * n, anchor_from_world @ pose, *render(LARGE, pose))
        for n, pose in enumerate(poses)
    ]


def turned(*degrees: float) -> list[Keyframe]:
    return keyframes_at(*(look(0.0, -0.5, np.radians(angle)) for angle in degrees))


def test_views_are_spread_farthest_first_and_no_more_than_asked_for() -> None:
    keyframes = turned(0, 10, 30, 60, 90, 120)
    assert spread_keyframes(keyframes, LARGE, 0) == []
    # The camera sees 60 degrees: those at 60 and beyond share nothing with the anchor.
    first = spread_keyframes(keyframes, LARGE, 1)
    assert first[0] in (3, 4, 5)
    chosen = spread_keyframes(keyframes, LARGE, 3)
    assert chosen[:1] == first
    assert len(chosen) == 3
    assert {3, 5} <= {*chosen}


def test_what_shows_nothing_new_is_not_described() -> None:
    assert spread_keyframes(turned(0, 3, 6, 9), LARGE, 8) == []
    assert spread_keyframes(turned(0, 2, 50, 52, 54), LARGE, 8) in ([2], [3], [4])
    assert spread_keyframes(turned(0), LARGE, 8) == []


def test_a_close_up_is_another_view_though_the_anchor_saw_all_of_it() -> None:
    keyframes = keyframes_at(look(0.0, -2.3, 0.0), look(0.0, 1.3, 0.0))
    assert spread_keyframes(keyframes, LARGE, 8) == [1]


def test_a_keyframe_without_depth_is_not_chosen() -> None:
    keyframes = turned(0, 90)
    blind = dataclasses.replace(keyframes[1], depth=np.zeros_like(keyframes[1].depth))
    assert spread_keyframes([keyframes[0], blind], LARGE, 8) == []


def test_the_chosen_ones_are_described_and_nothing_else_changes() -> None:
    keyframes = turned(0, 90, 5, 180)
    submap = dataclasses.replace(make_submap(camera=LARGE), keyframes=tuple(keyframes))
    seen: list[np.ndarray] = []

    def describe(colour: np.ndarray) -> Descriptor:
        seen.append(colour)
        return thumbnail(colour)

    assert with_described_keyframes(submap, describe, count=0) is submap
    assert seen == []
    described = with_described_keyframes(submap, describe, count=2)
    assert len(seen) == 2
    places = [n for n, one in enumerate(described.keyframes) if one.descriptor is not None]
    assert places == [1, 3]
    for place in places:
        expected = thumbnail(keyframes[place].colour).vector
        np.testing.assert_array_equal(described.keyframes[place].descriptor, expected)
    for before, after in zip(submap.keyframes, described.keyframes, strict=True):
        assert after.colour is before.colour
        assert after.anchor_from_camera is before.anchor_from_camera


@pytest.mark.parametrize("count", [-1, 33])
def test_a_number_that_no_server_takes_is_refused(count: int) -> None:
    with pytest.raises(ConfigError, match=f"places_keyframes: {count}: expected 0 to 32"):
        AgentConfig(places_keyframes=count).validate()
    AgentConfig(places_keyframes=32).validate()


CAMERA = LARGE.scaled(0.5)


class Turn:
    """A camera that turns where it stands, 60 degrees in all."""

    name, camera = "agent_0", CAMERA

    def __init__(self) -> None:
        poses = [look(-0.8, -0.8, np.radians(2.5 * step)) for step in range(25)]
        self._frames = [Frame(n, n / 30, *render(CAMERA, pose)) for n, pose in enumerate(poses)]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]


class Thumbnails:
    """A weak but real descriptor model."""

    model_id, dimension = MODEL_ID, DIMENSION
    describe = staticmethod(thumbnail)


async def test_an_agent_sends_descriptors_of_at_most_so_many_keyframes(
    client: MagicClient, tmp_path: Path
) -> None:
    source = Turn()
    agent = Agent(
        source,
        client,
        session="turn",
        name="agent_0",
        config=AgentConfig(
            places_keyframes=2,
            mapping=MappingConfig(iterations=4, anchor_iterations=8, closing_iterations=0),
            submap=SubmapConfig(frames=40, min_anchor_overlap=0.0),
        ),
        model=Thumbnails(),
        folder=tmp_path / "agent_0",
    )
    tally = await agent.run()
    assert tally.completed
    (info,) = await client.list_submaps("turn")
    header = (await client.download_encoded(info.name)).header
    described = [one for one in header.keyframes if one.image_descriptor]
    assert 1 <= len(described) <= 2
    assert not header.keyframes[0].image_descriptor
    for keyframe in described:
        expected = thumbnail(source[keyframe.frame_index].colour).vector
        np.testing.assert_array_equal(np.float32(keyframe.image_descriptor), expected)
