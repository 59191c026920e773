"""Corrections spread between sub-maps: both sides meet, middles stay, agreement moves nothing."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.geometry import se3
from magic_core.geometry.seams import NO_SEAMS, Seams, seams_between

FRAMES = 20
SHARES = np.arange(FRAMES) / FRAMES


def walk(step: np.ndarray) -> np.ndarray:
    """(n, 4, 4) frames of a sub-map, each one step further."""
    return np.stack([se3.exp(number * step) for number in range(FRAMES)])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 0.3, 2.0])
def test_fractions_of_a_motion_are_what_exp_says_one_by_one(size, rng):
    xi = size * rng.normal(size=6)
    shares = np.array([0.0, -0.4, 0.5, 1.0])
    expected = np.stack([se3.exp(share * xi) for share in shares])
    np.testing.assert_allclose(se3.fractions(xi, shares), expected, atol=1e-14)
    assert se3.fractions(xi, []).shape == (0, 4, 4)


def test_frames_of_one_sub_map_stay_where_they_are(rng):
    frames = walk(0.02 * rng.normal(size=6))
    np.testing.assert_array_equal(NO_SEAMS.spread(frames, SHARES), frames)
    assert NO_SEAMS.spread([], []).shape == (0, 4, 4)


def test_sub_maps_that_agree_are_not_moved(rng):
    motion = se3.exp(rng.normal(size=6))
    anchors = {0: se3.exp(rng.normal(size=6))}
    anchors[1] = anchors[0] @ motion
    seams = seams_between(anchors, {1: (0, motion)})
    frames = walk(0.02 * rng.normal(size=6))
    for name in anchors:
        np.testing.assert_allclose(seams[name].spread(frames, SHARES), frames, atol=1e-12)


def test_both_sides_of_a_seam_meet_and_the_middles_stay(rng):
    step = 0.02 * rng.normal(size=6)
    frames, motion = walk(step), se3.exp(FRAMES * step)
    anchors = {"a": se3.identity(), "b": motion @ se3.exp([0.08, 0.0, -0.02, 0.0, 0.05, 0.0])}
    seams = seams_between(anchors, {"b": ("a", motion)})
    shares = np.append(SHARES, 1.0)
    before = anchors["a"] @ seams["a"].spread([*frames, motion], shares)
    behind = anchors["b"] @ seams["b"].spread(frames, SHARES)
    np.testing.assert_allclose(before[-1], behind[0], atol=1e-12)
    np.testing.assert_array_equal(before[: FRAMES // 2], frames[: FRAMES // 2])
    unmoved = anchors["b"] @ frames[FRAMES // 2 :]
    np.testing.assert_allclose(behind[FRAMES // 2 :], unmoved, atol=1e-14)


def test_drift_that_grows_evenly_is_taken_out_where_the_ends_are_known(rng):
    """Each sub-map's middle is right, so every frame between two middles should be."""
    drift = np.array([0.002, -0.001, 0.0005, 0.0, 0.0, 0.0])
    true = np.stack([se3.exp([0.03 * number, 0, 0, 0, 0, 0]) for number in range(3 * FRAMES)])
    tracked = np.stack([pose @ se3.exp(k * drift) for k, pose in enumerate(true)])
    anchors, odometry, parts = {}, {}, {}
    for name in range(3):
        mine = tracked[name * FRAMES : (name + 1) * FRAMES]
        parts[name] = se3.inverse(mine[0]) @ mine
        middle = FRAMES // 2
        anchors[name] = true[name * FRAMES + middle] @ se3.inverse(parts[name][middle])
        if name:
            first = tracked[(name - 1) * FRAMES]
            odometry[name] = name - 1, se3.inverse(first) @ mine[0]
    seams = seams_between(anchors, odometry)

    def worst(spread: dict[int, Seams]) -> float:
        found = np.concatenate(
            [anchors[n] @ spread[n].spread(parts[n], SHARES) for n in anchors]
        )  # fmt: skip
        between = slice(FRAMES // 2, 2 * FRAMES + FRAMES // 2)
        return float(np.abs(found[between, :3, 3] - true[between, :3, 3]).max())

    assert worst(dict.fromkeys(anchors, NO_SEAMS)) > 0.015
    assert worst(seams) < 1e-6


def test_one_without_a_place_has_no_seam():
    seams = seams_between({1: se3.identity()}, {1: (0, se3.exp([0.1, 0, 0, 0, 0, 0]))})
    assert seams == {1: NO_SEAMS}


def test_shares_that_do_not_fit_the_frames_are_refused(rng):
    with pytest.raises(ValueError, match="20 frames"):
        Seams().spread(walk(rng.normal(size=6)), [0.0])
