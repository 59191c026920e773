"""The order in which the fine stage visits keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.geometry import Camera, se3
from magic_server.globalmap.placement import View
from magic_server.globalmap.sampling import VisitOrder, region_weights

CAMERA = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)


def view_at(x: float, depth: float = 2.0) -> View:
    """A view of a wall at z = depth, from x metres along it."""
    pose = se3.from_rotation_translation(np.eye(3), [x, 0.0, 0.0])
    colour = np.full((48, 64, 3), 100, np.uint8)
    return View(CAMERA, pose, colour, np.full((48, 64), depth, np.float32))


def test_a_place_seen_once_outweighs_one_seen_often():
    weights = region_weights([view_at(0.0)] * 9 + [view_at(100.0)])
    assert weights[-1] == pytest.approx(0.5, rel=1e-6)
    assert weights[:9].sum() == pytest.approx(0.5, rel=1e-6)


def test_weights_sum_to_one_and_views_without_depth_keep_a_share():
    weights = region_weights([view_at(0.0), view_at(1.0), view_at(2.0, depth=0.0)])
    assert weights.sum() == pytest.approx(1.0)
    assert weights[2] == weights.min() > 0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_visits_follow_the_weights_closely(seed):
    weights = np.array([0.5, 0.3, 0.15, 0.05])
    order = VisitOrder(weights, np.random.default_rng(seed))
    visits = np.bincount([order.next() for _ in range(100)], minlength=4)
    assert np.abs(visits - 100 * weights).max() <= 2.0


def test_order_depends_on_the_seed_alone():
    weights = np.full(20, 0.05)
    orders = [
        [order.next() for _ in range(60)]
        for order in (VisitOrder(weights, np.random.default_rng(s)) for s in (0, 0, 1))
    ]
    assert orders[0] == orders[1]
    assert orders[0] != orders[2]
