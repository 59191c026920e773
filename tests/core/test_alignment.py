"""Rigid alignment of corresponding points."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.errors import InvalidInput
from magic_core.geometry import se3
from magic_core.geometry.alignment import align_points


@pytest.mark.parametrize("seed", range(8))
def test_recovers_the_motion_between_two_copies(seed):
    rng = np.random.default_rng(seed)
    truth = se3.exp(rng.normal(size=6) * (3, 3, 3, 1.5, 1.5, 1.5))
    source = rng.normal(size=(30, 3)) + np.array([100, -50, 20])
    found = align_points(source, se3.transform_points(truth, source))
    np.testing.assert_allclose(found, truth, atol=1e-9)


def test_no_small_motion_does_better():
    rng = np.random.default_rng(1)
    source = rng.normal(size=(40, 3))
    target = se3.transform_points(se3.exp([1, 2, 3, 0.4, 0.5, 0.6]), source)
    target += 0.05 * rng.normal(size=target.shape)
    best = align_points(source, target)

    def cost(transform: np.ndarray) -> float:
        return float(((se3.transform_points(transform, source) - target) ** 2).sum())

    for direction in np.vstack([np.eye(6), -np.eye(6)]):
        assert cost(best @ se3.exp(1e-4 * direction)) > cost(best)


def test_a_mirrored_copy_gets_a_rotation_not_a_reflection():
    source = np.random.default_rng(2).normal(size=(20, 3))
    found = align_points(source, source * (1, 1, -1))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_flat_clouds_are_aligned_exactly():
    source = np.random.default_rng(3).normal(size=(20, 3)) * (1, 1, 0)
    truth = se3.exp([0.1, 0.2, 0.3, 1.0, -2.0, 0.5])
    np.testing.assert_allclose(
        align_points(source, se3.transform_points(truth, source)), truth, atol=1e-9
    )


def test_a_straight_path_is_laid_on_its_copy_though_its_roll_is_free():
    source = np.outer(np.linspace(0, 3, 10), (0.6, 0.0, 0.8))
    target = se3.transform_points(se3.exp([1, 1, 1, 0.3, 0.2, 0.1]), source)
    found = align_points(source, target)
    np.testing.assert_allclose(se3.transform_points(found, source), target, atol=1e-9)


def test_points_of_zero_weight_do_not_count():
    source = np.random.default_rng(4).normal(size=(20, 3))
    truth = se3.exp([0.5, 0, 0, 0, 0.5, 0])
    target = se3.transform_points(truth, source)
    target[:5] += 10.0
    weights = np.where(np.arange(20) < 5, 0.0, 2.0)
    np.testing.assert_allclose(align_points(source, target, weights=weights), truth, atol=1e-9)


@pytest.mark.parametrize(
    ("source", "target"),
    [(np.zeros((0, 3)), np.zeros((0, 3))), (np.zeros((3, 3)), np.zeros((4, 3))),
     (np.zeros((3, 2)), np.zeros((3, 2))), (np.full((3, 3), np.nan), np.zeros((3, 3)))],
)  # fmt: skip
def test_impossible_input_is_refused(source, target):
    with pytest.raises(InvalidInput):
        align_points(source, target)
