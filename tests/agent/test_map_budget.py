"""Mapping within a budget of steps and of time (a clock that ticks at each look)."""

from __future__ import annotations

import pytest

from magic_agent.mapping import Mapper, MappingBudget, MappingConfig
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.geometry import Camera, se3
from tests.small_world import look, render

CAMERA = Camera(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)
CONFIG = MappingConfig(iterations=12, anchor_iterations=12, settle=0.0, least_iterations=3)
FRAME = Frame(0, 0.0, *render(CAMERA, look(-0.8, -0.8, 0.2)))


class Clock:
    """Each look at it takes 10 ms."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 0.01
        return self.now


def mapper() -> Mapper:
    return Mapper(CAMERA, CONFIG, threads=1, clock=Clock())


def test_steps_end_with_the_time_and_the_rest_is_reported_as_cut():
    report = mapper().begin(FRAME, budget=MappingBudget(seconds=0.075))
    assert (report.iterations, report.cut_iterations) == (6, 6)


def test_the_least_steps_are_taken_even_when_the_time_is_over():
    report = mapper().begin(FRAME, budget=MappingBudget.within(-1.0, CONFIG))
    assert (report.iterations, report.cut_iterations) == (3, 9)
    assert report.seeded > 100


def test_without_a_limit_the_schedule_is_run_in_full():
    report = mapper().begin(FRAME, budget=MappingBudget.within(None, CONFIG))
    assert (report.iterations, report.cut_iterations) == (12, 0)


def test_a_budget_of_steps_replaces_the_schedules():
    report = mapper().begin(FRAME, budget=MappingBudget(iterations=20))
    assert (report.iterations, report.cut_iterations) == (20, 0)


def test_a_mapper_learns_what_a_keyframe_takes_at_least():
    new = mapper()
    assert new.least_s == 0.0
    new.begin(FRAME)
    # Four looks around seeding, steps and pruning, and one before each of the twelve steps.
    assert new.least_s == pytest.approx(0.02 + 3 * 0.13 / 12)


def test_steps_of_a_negative_number_are_refused():
    with pytest.raises(ConfigError, match=r"mapping\.least_iterations"):
        MappingConfig(least_iterations=-1).resolved()


def test_a_keyframe_may_be_judged_by_a_view_rendered_before():
    new = mapper()
    new.begin(FRAME)
    turned = look(-0.8, -0.8, 0.9)
    pose = se3.inverse(look(-0.8, -0.8, 0.2)) @ turned
    frame = Frame(3, 0.1, *render(CAMERA, turned))
    view = new.render(pose)
    assert new.wants(frame, pose, view=view) == new.wants(frame, pose) is True
    assert new.lacks(frame, pose, view=view)
