"""Guessed depth where the sensor has no reading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magic_agent.mapping import Mapper, MappingConfig
from magic_agent.mapping.holes import filled
from magic_core.data import Frame
from magic_core.geometry import Camera, se3
from tests.small_world import look, render

CAMERA = Camera(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)


def test_a_hole_takes_the_farther_of_the_readings_beside_it():
    row = np.array([[0, 1, 0, 0, 3, 0, 2, 0]], np.float32)
    assert filled(row).tolist() == [[1, 1, 3, 3, 3, 3, 2, 2]]


def test_rows_without_a_reading_are_those_of_the_nearest_row():
    depth = np.zeros((5, 3), np.float32)
    depth[1], depth[4] = 1.0, 2.0
    assert filled(depth)[:, 0].tolist() == [1, 1, 1, 2, 2]


def test_without_any_reading_nothing_is_guessed():
    assert not filled(np.zeros((4, 6), np.float32)).any()


def test_readings_stay_what_they_are():
    depth = np.random.default_rng(0).uniform(0.5, 3.0, (20, 30)).astype(np.float32)
    holes = np.random.default_rng(1).random((20, 30)) < 0.3
    holed = np.where(holes, np.float32(0), depth)
    result = filled(holed)
    assert np.array_equal(result[~holes], depth[~holes])
    assert (result > 0).all()


@pytest.mark.parametrize(("fill_holes", "explained"), [(True, True), (False, False)])
def test_what_only_colour_shows_is_mapped_where_holes_are_filled(fill_holes, explained):
    colour, depth = render(CAMERA, look(-0.8, -0.8, 0.2))
    depth[20:50, 30:60] = 0.0
    config = MappingConfig(iterations=5, anchor_iterations=10)
    mapper = Mapper(CAMERA, replace(config, fill_holes=fill_holes), threads=1)
    mapper.begin(Frame(0, 0.0, colour, depth))
    inside = mapper.render(se3.identity()).alpha[28:42, 38:52]
    assert bool((inside > 0.9).mean() > 0.9) is explained
