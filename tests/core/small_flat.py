"""A small, quickly lit synthetic flat and tiny recordings, for tests of data and evaluation."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np

from magic_core.data import Frame, FrameSource
from magic_core.data.synthetic import SyntheticConfig, synthetic_flat

SMALL = SyntheticConfig(
    agents=3, frames=24, width=96, height=72, depth_noise=False, detail="draft", seed=5
)
SHARED_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


@functools.cache
def small_flat() -> tuple[FrameSource, ...]:
    """Sources of the small flat; exact depth."""
    return tuple(synthetic_flat(SMALL))


@functools.cache
def small_frames(agent: int) -> tuple[Frame, ...]:
    """All frames of one agent of the small flat, rendered once."""
    return tuple(small_flat()[agent])


def write_gray_replica(
    folder: Path, *, frames: int = 4, first: int = 0, depth_units: int = 2000
) -> Path:
    """A tiny recording in the Replica layout, written without our own writer."""
    results = folder / "results"
    results.mkdir(parents=True)
    for number in range(first, first + frames):
        colour = np.full((12, 16, 3), 10 * (number - first), np.uint8)
        depth = np.full((12, 16), depth_units + number, np.uint16)
        cv2.imwrite(str(results / f"frame{number:06d}.jpg"), colour)
        cv2.imwrite(str(results / f"depth{number:06d}.png"), depth)
    poses = [np.eye(4) for _ in range(frames)]
    for k, pose in enumerate(poses):
        pose[0, 3] = 0.1 * k
    np.savetxt(folder / "traj.txt", np.array(poses).reshape(-1, 16))
    (folder / "cam_params.json").write_text(
        '{"camera": {"w": 16, "h": 12, "fx": 14, "fy": 14, "cx": 7.5, "cy": 5.5, "scale": 1000}}'
    )
    return folder
