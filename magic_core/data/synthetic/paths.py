"""Where the agents walk: overlapping stretches of one walk round the flat.

All agents follow one closed curve, each with its own sway and glances, every other one in the
opposite direction. Where a stretch is shared, two agents look at the same things from nearby, so
that places can be recognised between them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

Array = NDArray[np.float64]

STEP_M = 0.030
"""Translation that costs a whole frame."""
TURN_RAD = np.deg2rad(1.6)
"""Rotation that costs a whole frame."""
STRETCH = 0.55
"""How far along each agent starts after the previous one, as a share of its length."""

# x, y, z (metres), yaw (degrees counter-clockwise from east), pitch (degrees, down is negative).
_WALK = np.array(
    [
        (1.20, 3.45, 1.50, -42, -14), (2.10, 3.15, 1.48, -66, -16), (3.10, 3.10, 1.47, -84, -15),
        (4.10, 3.05, 1.48, -60, -13), (4.95, 2.75, 1.50, -24, -10), (5.86, 2.55, 1.50, -4, -10),
        (6.60, 2.95, 1.50, -14, -13), (7.20, 3.50, 1.50, 0, -13), (7.75, 4.05, 1.50, 44, -10),
        (8.07, 4.66, 1.50, 84, -9), (7.95, 5.55, 1.50, 104, -12), (7.20, 6.05, 1.50, 128, -14),
        (6.30, 6.15, 1.50, 158, -12), (5.40, 6.05, 1.50, 180, -10), (4.66, 6.07, 1.50, 184, -10),
        (3.90, 5.80, 1.50, 172, -13), (3.00, 5.62, 1.50, 168, -15), (2.00, 5.58, 1.50, 196, -14),
        (1.30, 5.30, 1.50, 240, -10), (1.07, 4.66, 1.50, 272, -9), (1.00, 4.05, 1.50, 300, -11),
    ]
)  # fmt: skip


def walk_poses(agent: int, frames: int, *, rng: np.random.Generator) -> Array:
    """(frames, 4, 4) world_from_camera of one agent, OpenCV camera axes."""
    curve = _closed_walk(rng)
    start = round(agent * STRETCH * frames)
    order = np.arange(start, start + frames)
    if agent % 2:
        order = order[::-1]
    return curve[order % len(curve)]


def _closed_walk(rng: np.random.Generator) -> Array:
    """The whole walk, resampled so that every frame moves about equally much."""
    knots = np.vstack([_WALK, _WALK[0] + np.array([0, 0, 0, 360, 0])])
    distance = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1))]
    )
    fine = np.linspace(0, distance[-1], 6001)
    values = np.empty((len(fine), 5))
    values[:, :3] = CubicSpline(distance, knots[:, :3], bc_type="periodic")(fine)
    values[:, 3:] = PchipInterpolator(distance, knots[:, 3:])(fine)
    values += _sway(fine / distance[-1], rng)
    poses = _looking(values)
    cost = np.concatenate([[0.0], np.cumsum(_frame_cost(poses))])
    count = int(cost[-1])
    nearest = np.linspace(0, cost[-1], count, endpoint=False)
    resampled = np.stack([np.interp(nearest, cost, column) for column in values.T], axis=1)
    return _looking(resampled)


def _sway(share: Array, rng: np.random.Generator) -> Array:
    """Smooth periodic deviations: a few centimetres and degrees, different for every agent."""
    amplitude = np.array([0.05, 0.05, 0.035, 3.0, 2.0])
    total = np.zeros((len(share), 5))
    for waves in (7, 12, 19):
        phase = rng.uniform(0, 2 * np.pi, 5)
        total += np.sin(2 * np.pi * waves * share[:, None] + phase) * amplitude * 4 / waves / 1.4
    return total


def _looking(rows: Array) -> Array:
    """(n, 4, 4) camera poses at (x, y, z) that look along yaw and pitch (n, 5), without roll."""
    yaw, pitch = np.deg2rad(rows[:, 3:5].T)
    level = np.zeros_like(yaw)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 0] = np.stack([np.sin(yaw), -np.cos(yaw), level], axis=1)
    poses[:, :3, 2] = np.stack(
        [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=1
    )
    poses[:, :3, 1] = np.cross(poses[:, :3, 2], poses[:, :3, 0])
    poses[:, :3, 3] = rows[:, :3]
    return poses


def _frame_cost(poses: Array) -> Array:
    """How many frames the motion between successive poses takes."""
    step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    relative = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    trace = np.trace(relative, axis1=1, axis2=2)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return np.maximum(step / STEP_M, angle / TURN_RAD) * 0.7 + 0.3 * (
        step / STEP_M + angle / TURN_RAD
    )
