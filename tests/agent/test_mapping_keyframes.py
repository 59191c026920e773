"""Keyframe choice, the optimisation window, and the settings of mapping."""

from __future__ import annotations

import numpy as np
import pytest

from magic_agent.mapping import KeyframeConfig, MappingConfig
from magic_agent.mapping.keyframes import Window, moved_enough
from magic_core.errors import ConfigError
from magic_core.geometry import se3


@pytest.mark.parametrize(
    ("xi", "median_depth", "expected"),
    [
        ((0.09, 0, 0, 0, 0, 0), 2.0, False),
        ((0.11, 0, 0, 0, 0, 0), 2.0, True),
        ((0.11, 0, 0, 0, 0, 0), 4.0, False),  # the same shift moves far surface less
        ((0, 0, 0, 0, np.deg2rad(4.9), 0), 2.0, False),
        ((0, 0, 0, 0, np.deg2rad(5.1), 0), 2.0, True),
    ],
)
def test_moves_past_a_threshold_make_a_keyframe(xi, median_depth, expected):
    start = se3.exp([1.0, 2.0, 3.0, 0.3, -0.2, 0.5])
    rule = KeyframeConfig(translation=0.05, rotation_deg=5.0)
    pose = start @ se3.exp(xi)
    assert moved_enough(start, pose, median_depth=median_depth, config=rule) is expected


def choices(window: Window, losses: list[float], steps: int) -> np.ndarray:
    counts = np.zeros(len(losses))
    for _ in range(steps):
        index = window.choose()
        counts[index] += 1
        window.report(index, losses[index])
    return counts / steps


def window_of(count: int, newest_share: float, seed: int = 0) -> Window:
    window = Window(newest_share, np.random.default_rng(seed))
    for number in range(count):
        window.add(place(number), depth_m=2.0)
    return window


def place(number: int) -> np.ndarray:
    """A wall of 1 m, 10 m apart from the others."""
    y, z = np.meshgrid(np.linspace(0, 1, 12), np.linspace(0, 1, 12))
    return np.stack([np.full(y.size, 10.0 * number), y.ravel(), z.ravel()], axis=-1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_newest_keyframe_gets_its_share_and_no_other_is_left_out(seed):
    shares = choices(window_of(10, 0.4, seed), [0.1] * 10, 2000)
    assert 0.38 < shares[-1] < 0.52
    assert shares[:-1].min() > 0.3 / 10


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_badly_fitted_keyframes_are_looked_at_more_often(seed):
    losses = [0.05] * 10
    losses[3] = 0.5
    shares = choices(window_of(10, 0.2, seed), losses, 2000)
    assert shares[3] > 2.0 * np.median(shares[:-1])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_place_that_one_keyframe_shows_gets_as_many_looks_as_one_that_many_show(seed):
    window = Window(0.0, np.random.default_rng(seed))
    for number in (0, 1, 1, 1, 1, 1, 1, 1, 1):
        window.add(place(number), depth_m=2.0)
    shares = choices(window, [0.1] * 9, 2000)
    assert 0.2 < shares[0] < 0.5  # a ninth if keyframes were counted, not places
    assert shares[1:].min() > 0.04


def test_a_keyframe_without_depth_is_looked_at_too():
    window = Window(0.0, np.random.default_rng(0))
    window.add(place(0), depth_m=2.0)
    window.add(np.zeros((0, 3)), depth_m=1.0)
    window.add(place(1), depth_m=2.0)
    assert choices(window, [0.1] * 3, 500)[1] > 0.1


def test_a_single_keyframe_is_always_chosen():
    assert choices(window_of(1, 0.0), [0.1], 20)[0] == 1.0


def test_paper_schedule_puts_the_papers_values_in():
    config = MappingConfig(schedule="paper", iterations=7).resolved()
    assert (config.iterations, config.keyframe_every, config.seeding) == (100, 5, "uniform")
    assert (config.alpha_threshold, config.seed_opacity) == (0.98, 0.5)


def test_fast_schedule_keeps_what_the_user_set():
    assert MappingConfig(iterations=7).resolved().iterations == 7


@pytest.mark.parametrize(
    ("name", "value"),
    [("iterations", 0), ("newest_share", 1.5), ("seed_opacity", 1.0), ("max_gaussians", -1)],
)
def test_values_out_of_range_are_named(name, value):
    with pytest.raises(ConfigError, match=f"mapping.{name}"):
        MappingConfig(**{name: value}).resolved()
