"""The sub-map under construction and its odometry edge."""

from __future__ import annotations

import numpy as np
import pytest

from magic_agent.odometry import ActiveSubmap, hand_over_edge
from magic_agent.slam_config import SubmapConfig
from magic_core.data import Frame
from magic_core.geometry import se3
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
