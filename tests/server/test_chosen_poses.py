"""Which sub-maps a map is made of."""

from __future__ import annotations

import pytest
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.errors import NotFound, WrongState
from magic_server.globalmaps import chosen_poses


def snapshot(*components: str, listed: tuple[str, ...] = ()) -> mapping_pb.PoseSnapshot:
    """One pose in each of the components given, and the list of components."""
    return mapping_pb.PoseSnapshot(
        session="sessions/room",
        poses=[
            mapping_pb.CorrectedPose(submap=f"sessions/room/agents/a/submaps/{i}", component=name)
            for i, name in enumerate(components)
        ],
        components=[mapping_pb.Component(id=name) for name in listed],
    )


def indices(poses: list[mapping_pb.CorrectedPose]) -> list[int]:
    return [int(pose.submap.rsplit("/", 1)[1]) for pose in poses]


def test_the_largest_component_is_the_first_listed():
    poses = snapshot("small", "large", "large", listed=("large", "small"))
    assert indices(chosen_poses(poses, "")) == [1, 2]
    assert indices(chosen_poses(poses, "small")) == [0]


def test_without_a_list_of_components_the_largest_is_counted():
    assert indices(chosen_poses(snapshot("small", "large", "large"), "")) == [1, 2]


def test_a_component_goes_by_any_of_its_sub_maps():
    poses = snapshot("large", "large", listed=("large",))
    assert indices(chosen_poses(poses, "sessions/room/agents/a/submaps/1")) == [0, 1]


def test_nothing_placed_and_unknown_components_are_refused():
    with pytest.raises(WrongState, match="nothing to merge"):
        chosen_poses(snapshot(), "")
    with pytest.raises(NotFound, match="no component"):
        chosen_poses(snapshot("large", listed=("large",)), "other")
