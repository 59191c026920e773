"""Mapping within a budget of steps and of time (a clock that ticks at each look)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magic_agent.mapping import Mapper, MappingBudget, MappingConfig
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.geometry import Camera, se3
from magic_core.submap import Keyframe
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


def mapper_after_begin() -> Mapper:
    new = mapper()
    new.begin(FRAME)
    return new


def colour_error(mapper: Mapper, keyframe: Keyframe) -> float:
    view = mapper.render(keyframe.anchor_from_camera)
    return float(np.abs(view.colour - keyframe.colour / 255.0).mean())


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
    steps_s = 3 * 0.13 / 12  # one look before each of the twelve steps, and one after them
    assert new.least_s == pytest.approx(steps_s)  # an anchor's seeding is no keyframe's
    new.insert(FRAME, se3.identity())
    assert new.least_s == pytest.approx(0.02 + steps_s)  # four looks around seeding and pruning


@pytest.mark.parametrize("name", ["least_iterations", "closing_iterations"])
def test_steps_of_a_negative_number_are_refused(name):
    with pytest.raises(ConfigError, match=rf"mapping\.{name}"):
        replace(MappingConfig(), **{name: -1}).resolved()


def test_closing_takes_its_steps_as_far_as_the_time_goes():
    config = replace(CONFIG, closing_iterations=30)
    new = Mapper(CAMERA, config, threads=1, clock=Clock())
    opening = new.begin(FRAME)
    short = new.close(budget=MappingBudget(seconds=0.055))
    assert (short.iterations, short.cut_iterations) == (5, 25)
    report = short.added_to(opening)
    assert (report.iterations, report.cut_iterations) == (17, 25)
    assert new.close(budget=MappingBudget(seconds=-1.0)).iterations == 0
    assert new.close().iterations == 30
    assert mapper_after_begin().close().iterations == 0  # unless it is asked for


def test_closing_sharpens_all_keyframes_of_a_sub_map():
    second = look(-0.8, -0.8, 0.4)
    pose = se3.inverse(look(-0.8, -0.8, 0.2)) @ second
    new = mapper_after_begin()
    new.insert(Frame(5, 0.2, *render(CAMERA, second)), pose)
    before = [colour_error(new, keyframe) for keyframe in new.keyframes]
    new.close(budget=MappingBudget(iterations=60))
    after = [colour_error(new, keyframe) for keyframe in new.keyframes]
    assert all(late < 0.9 * early for early, late in zip(before, after, strict=True))


def test_a_keyframe_may_be_judged_by_a_view_rendered_before():
    new = mapper()
    new.begin(FRAME)
    turned = look(-0.8, -0.8, 0.9)
    pose = se3.inverse(look(-0.8, -0.8, 0.2)) @ turned
    frame = Frame(3, 0.1, *render(CAMERA, turned))
    view = new.render(pose)
    assert new.wants(frame, pose, view=view) == new.wants(frame, pose) is True
    assert new.lacks(frame, pose, view=view)
