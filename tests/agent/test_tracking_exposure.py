"""Exposure jumps between frames: found before alignment, carried along, never taken for motion."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.tracking.exposure import SAME, Exposure, exposure_jump, matched
from magic_agent.tracking.pyramid import Pyramid, image_pyramid
from magic_core.data import Frame


def pyramid(frame: Frame) -> Pyramid:
    return image_pyramid(frame.colour, frame.depth, camera=CAMERA, levels=3)


def exposed(frame: Frame, gain: float, bias: float = 0.0) -> Frame:
    colour = np.clip(gain * frame.colour.astype(np.float32) + 255.0 * bias, 0.0, 255.0)
    return replace(frame, colour=colour.astype(np.uint8))


@pytest.mark.parametrize(
    ("gain", "bias"), [(0.5, 0.0), (0.35, 0.05), (1.5, 0.0), (1.25, -0.05), (0.8, 0.1)]
)
def test_a_jump_is_found_between_frames_of_a_moving_camera(gain, bias):
    first, second = (room_frame(pose, i, noise_seed=i) for i, pose in enumerate(walk(2)))
    jump = exposure_jump(pyramid(first), pyramid(exposed(second, gain, bias)))
    assert jump.gain * gain == pytest.approx(1.0, abs=0.12)
    middle = 0.5
    assert jump.gain * (gain * middle + bias) + jump.bias == pytest.approx(middle, abs=0.03)


def test_moving_alone_is_no_jump():
    frames = [room_frame(pose, i, noise_seed=i) for i, pose in enumerate(walk(8, speed=2.0))]
    for earlier, later in pairwise(frames):
        assert exposure_jump(pyramid(earlier), pyramid(later)) == SAME


@pytest.mark.parametrize("level", [0, 3, 128, 255])
def test_an_image_of_one_colour_tells_nothing(level):
    frame = room_frame(walk(1)[0])
    flat = replace(frame, colour=np.full_like(frame.colour, level))
    assert exposure_jump(pyramid(frame), pyramid(flat)) == SAME
    assert matched(np.zeros(0, np.float32), np.zeros(0, np.float32)) == SAME


def test_corrections_chain():
    first, second = Exposure(2.0, 0.1), Exposure(0.5, -0.05)
    value = 0.3
    once = first.gain * value + first.bias
    assert second.gain * once + second.bias == pytest.approx(
        second.after(first).gain * value + second.after(first).bias
    )


def test_a_corrected_frame_looks_as_before():
    frame = room_frame(walk(1)[0])
    darker = exposed(frame, 0.5, 0.02)
    again = Exposure(2.0, -0.04).corrected(darker)
    assert np.abs(again.colour.astype(int) - frame.colour).max() <= 4  # 8 bits, halved
    assert np.array_equal(again.depth, frame.depth)
