"""Keyframes of another exposure: found against the sub-map, removed, and only when needed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magic_agent.mapping import Mapper, MappingConfig
from magic_agent.mapping.exposure import exposure_of
from magic_core.data import Frame
from magic_core.geometry import Camera, se3
from tests.small_world import look, render

CAMERA = Camera(width=128, height=96, fx=112.0, fy=112.0, cx=63.5, cy=47.5)
CONFIG = MappingConfig(iterations=15, anchor_iterations=30, settle=0.0)
START = look(-0.8, -0.8, 0.2)
NEXT = se3.exp([0.1, 0.0, 0.05, 0.0, 0.08, 0.0])


def frame_at(pose: np.ndarray, index: int, *, gain: float = 1.0, bias: float = 0.0) -> Frame:
    colour, depth = render(CAMERA, START @ pose)
    bright = np.clip(gain * colour.astype(np.float64) + 255.0 * bias, 0, 255)
    return Frame(index, index / 30, bright.astype(np.uint8), depth)


def mapped(*frames: tuple[Frame, np.ndarray], config: MappingConfig = CONFIG) -> Mapper:
    mapper = Mapper(CAMERA, config, threads=1)
    mapper.begin(frames[0][0])
    for frame, pose in frames[1:]:
        mapper.insert(frame, pose)
    return mapper


def psnr(mapper: Mapper, frame: Frame, pose: np.ndarray) -> float:
    error = mapper.render(pose).colour - frame.colour / 255.0
    return float(-10 * np.log10(np.mean(error**2)))


@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.0), (0.6, 0.0), (1.3, -0.05), (0.8, 0.1)])
def test_gain_and_bias_are_found_despite_noise_and_new_objects(gain, bias):
    rng = np.random.default_rng(0)
    rendered = rng.uniform(0.1, 0.7, (96, 128, 3)).astype(np.float32)
    image = gain * rendered + bias + rng.normal(0.0, 0.01, rendered.shape)
    image[:20] = 0.9  # something that the sub-map does not know
    colour = np.clip(255.0 * image, 0, 255).astype(np.uint8)
    found = exposure_of(colour, rendered, np.ones((96, 128), np.float32))
    assert found is not None
    assert np.allclose(found.gain, gain, atol=0.03)
    assert np.allclose(found.bias, bias, atol=0.015)
    back = found.removed(colour)[20:] / 255.0 - rendered[20:]
    assert np.median(np.abs(back)) < 0.02


def test_what_shows_no_mapped_surface_has_no_exposure():
    frame = frame_at(np.eye(4), 0)
    blank = np.zeros((96, 128, 3), np.float32)
    assert exposure_of(frame.colour, blank, np.zeros((96, 128), np.float32)) is None
    flat = np.full((96, 128, 3), 128, np.uint8)
    assert exposure_of(flat, blank + 0.5, np.ones((96, 128), np.float32)) is None


def test_frames_of_one_exposure_are_mapped_as_if_there_were_no_handling():
    frames = [(frame_at(np.eye(4), 0), np.eye(4)), (frame_at(NEXT, 1), NEXT)]
    with_it, without = (
        mapped(*frames, config=replace(CONFIG, exposure_step=step)) for step in (0.2, 0.0)
    )
    assert np.array_equal(with_it.gaussians().colours, without.gaussians().colours)


def test_a_jump_of_exposure_does_not_smear_the_map():
    first = frame_at(np.eye(4), 0)
    jumped = frame_at(NEXT, 1, gain=0.5)
    frames = [(first, np.eye(4)), (jumped, NEXT), (jumped, NEXT)]
    handled, smeared = (
        mapped(*frames, config=replace(CONFIG, exposure_step=step)) for step in (0.2, 0.0)
    )
    assert psnr(handled, first, np.eye(4)) > psnr(smeared, first, np.eye(4)) + 3.0
    as_first = frame_at(NEXT, 1)
    assert psnr(handled, as_first, NEXT) > psnr(smeared, as_first, NEXT) + 3.0


def test_keyframes_are_sent_as_the_camera_took_them():
    jumped = frame_at(NEXT, 1, gain=0.5)
    mapper = mapped((frame_at(np.eye(4), 0), np.eye(4)), (jumped, NEXT))
    assert np.array_equal(mapper.keyframes[1].colour, jumped.colour)


def test_a_new_sub_map_has_the_exposure_of_its_anchor():
    mapper = mapped((frame_at(np.eye(4), 0), np.eye(4)))
    carried = mapper.split(np.eye(4))[1]
    dark = frame_at(np.eye(4), 1, gain=0.5)
    config = replace(CONFIG, anchor_iterations=1)
    follower = Mapper(CAMERA, config, threads=1)
    assert follower.begin(dark, carried=carried).reexposed
    assert psnr(follower, dark, np.eye(4)) > 20.0
    same = frame_at(np.eye(4), 1)
    assert not follower.begin(same, carried=mapper.split(np.eye(4))[1]).reexposed
