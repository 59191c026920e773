"""The sub-map under construction and its odometry edge."""

from __future__ import annotations

import numpy as np
import pytest

from magic_agent.odometry import ActiveSubmap, anchor_overlap, hand_over_edge
from magic_agent.slam_config import SubmapConfig
from magic_core.data import Frame
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor


def submap_of(count: int) -> ActiveSubmap:
    descriptor = Descriptor("test", np.array([1.0], np.float32))
    active = ActiveSubmap(index=0, odometry=None, descriptor=descriptor, prior=None)
    for index in range(count):
        frame = Frame(
            index, index / 30, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32)
        )
        active.append(frame, se3.identity(), lost=False)
    return active


@pytest.mark.parametrize(
    ("count", "xi", "due"),
    [
        (9, (0, 0, 0, 0, 0, 0), False),
        (10, (0, 0, 0, 0, 0, 0), True),
        (5, (0.9, 0, 0, 0, 0, 0), False),
        (5, (1.1, 0, 0, 0, 0, 0), True),
        (4, (1.1, 0, 0, 0, 0, 0), False),  # too short for a hand-over by motion
        (5, (0, 0, 0, 0, np.deg2rad(61), 0), True),
    ],
)
def test_sub_map_ends_by_count_distance_or_turn(count, xi, due):
    rule = SubmapConfig(frames=10, min_frames=5, translation_m=1.0, rotation_deg=60.0)
    assert submap_of(count).is_due(se3.exp(xi), rule) is due


def test_sub_map_ends_where_its_anchor_no_longer_shows_the_frame():
    rule = SubmapConfig(frames=10, min_frames=5, min_anchor_overlap=0.3)
    here = se3.identity()
    assert submap_of(5).is_due(here, rule, overlap=lambda: 0.29)
    assert not submap_of(5).is_due(here, rule, overlap=lambda: 0.31)
    assert not submap_of(4).is_due(here, rule, overlap=lambda: 0.0)  # too short
    assert submap_of(10).is_due(here, rule, overlap=lambda: 1.0)


def test_overlap_with_the_anchor_counts_what_both_see():
    camera = Camera(width=160, height=120, fx=160.0, fy=160.0, cx=79.5, cy=59.5)
    wall = np.full((120, 160), 2.0, np.float32)

    def overlap(xi, anchor_depth=wall, depth=wall) -> float:
        pose = se3.exp(xi)
        return anchor_overlap(anchor_depth, depth, camera=camera, anchor_from_camera=pose)

    assert overlap([0, 0, 0, 0, 0, 0]) == 1.0
    assert overlap([1.0, 0, 0, 0, 0, 0]) == pytest.approx(0.5, abs=0.06)  # the wall is 2 m wide
    assert overlap([0, 0, 0, 0, np.pi, 0]) == 0.0
    near = np.where(np.arange(160)[None, :] < 80, 1.0, 2.0).astype(np.float32).repeat(120, 0)
    near = near.reshape(120, 160)
    assert overlap([0, 0, 0, 0, 0, 0], anchor_depth=near) == pytest.approx(0.5, abs=0.06)
    assert overlap([0, 0, 0, 0, 0, 0], depth=np.zeros_like(wall)) == 1.0


def test_motion_that_no_image_showed_weakens_the_edge_in_its_own_direction():
    rule, strong = SubmapConfig(), np.diag([1e6] * 6)
    active = submap_of(1)
    turned = se3.exp([0.3, 0, 0, 0, np.pi / 2, 0])  # the camera's z is the anchor's x
    for _ in range(4):
        frame = Frame(9, 0.3, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32))
        along_z = np.diag([0, 0, 0.02**2, 0, 0, 0])
        active.append(frame, turned, lost=False, unseen=along_z)
    edge = hand_over_edge(0, turned, strong, rule, unseen=active.unseen)
    seen = hand_over_edge(0, turned, strong, rule)
    extra = np.linalg.inv(edge.information) - np.linalg.inv(seen.information)
    assert np.sqrt(extra[2, 2]) == pytest.approx(0.04, rel=1e-3)  # four steps of 2 cm
    assert abs(extra[0, 0]) < 1e-9
    straight = se3.exp([0.3, 0, 0, 0, 0, 0])
    other = hand_over_edge(0, straight, strong, rule, unseen=active.unseen)
    assert np.sqrt(np.linalg.inv(other.information)[0, 0]) > 0.04  # the anchor's x


def test_edge_adds_the_drift_of_a_hand_over_to_the_trackers_covariance():
    rule = SubmapConfig(drift_translation_m=0.003, drift_rotation_deg=0.1)
    pose = se3.exp([0.5, 0.1, 0.0, 0.0, 0.2, 0.0])
    information = np.diag([1e6, 2e6, 3e6, 1e7, 2e7, 3e7])
    edge = hand_over_edge(4, pose, information, rule)
    expected = np.diag(1.0 / np.diag(information))
    expected += np.diag([0.003**2] * 3 + [np.deg2rad(0.1) ** 2] * 3)
    assert np.allclose(np.linalg.inv(edge.information), expected)
    assert edge.previous_index == 4
    assert np.array_equal(edge.previous_from_anchor, pose)


def test_edge_of_an_undetermined_direction_is_weak_but_valid():
    information = np.diag([1e6, 1e6, 0.0, 1e7, 1e7, 1e7])
    edge = hand_over_edge(0, se3.identity(), information, SubmapConfig())
    values = np.linalg.eigvalsh(edge.information)
    assert values.min() > 0
    assert edge.information[2, 2] < 2.0
