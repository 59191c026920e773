"""A sequence of RGB-D image files: what the loaders of all stored layouts produce."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.data.frame import Frame
from magic_core.data.images import ImagePreparation, read_colour, read_depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.errors import DataError
from magic_core.geometry import Camera


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """Where one frame lies on disk."""

    timestamp_s: float
    colour_path: Path
    depth_path: Path
    world_from_camera: NDArray[np.float64] | None = None
    """Ground truth (4, 4), None where the recording has none for this frame."""


class FileSequence:
    """A FrameSource that reads image files lazily, one frame at a time."""

    def __init__(
        self, name: str, files: Sequence[FrameFiles], *, intrinsics: Intrinsics, scale: float = 1.0
    ) -> None:
        self.name = name
        self.files = tuple(files)
        self.intrinsics = intrinsics
        self._preparation = ImagePreparation.plan(intrinsics, scale)
        self.camera: Camera = self._preparation.camera
        """Intrinsics of the frames as delivered: undistorted and scaled."""

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def timed_poses(self) -> list[tuple[float, NDArray[np.float64] | None]]:
        """(timestamp, ground truth) of every frame, without reading any image."""
        return [(files.timestamp_s, files.world_from_camera) for files in self.files]

    def __getitem__(self, index: int) -> Frame:
        """Read frame `index`; IndexError past the end, DataError where a file is unreadable."""
        position = range(len(self.files))[index]
        files = self.files[position]
        colour = read_colour(files.colour_path)
        depth = read_depth(files.depth_path, self.intrinsics.depth_scale)
        self._check_size(colour.shape[:2], files.colour_path)
        self._check_size(depth.shape, files.depth_path)
        return Frame(
            index=position,
            timestamp_s=files.timestamp_s,
            colour=self._preparation.colour(colour),
            depth=self._preparation.depth(depth),
            world_from_camera=files.world_from_camera,
        )

    def _check_size(self, shape: tuple[int, ...], path: Path) -> None:
        camera = self.intrinsics.camera
        if shape != (camera.height, camera.width):
            raise DataError(
                f"{path}: {shape[1]}x{shape[0]} pixels, but the intrinsics are for "
                f"{camera.width}x{camera.height}; correct cam_params.json, or register depth to "
                "colour so that both have one size"
            )


def subsample(
    files: Sequence[FrameFiles], *, stride: int = 1, max_frames: int | None = None
) -> tuple[FrameFiles, ...]:
    """Every `stride`-th frame, at most `max_frames` of them."""
    if stride < 1:
        raise DataError(f"stride {stride}: expected 1 (every frame) or more")
    if max_frames is not None and max_frames < 1:
        raise DataError(f"max_frames {max_frames}: expected 1 or more, or nothing for all")
    return tuple(files[::stride][:max_frames])


def require_increasing_times(files: Sequence[FrameFiles], *, where: Path) -> None:
    """Raise DataError where time stands still or runs back."""
    for before, after in pairwise(files):
        if not after.timestamp_s > before.timestamp_s:
            raise DataError(
                f"{where}: {after.colour_path.name} at {after.timestamp_s:.6f} s follows "
                f"{before.timestamp_s:.6f} s; timestamps must increase. Sort the list, and drop "
                "doubled lines."
            )
