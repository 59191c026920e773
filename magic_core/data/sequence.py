"""A stored RGB-D sequence: what the loaders of all layouts produce."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from magic_core.data.frame import Frame
from magic_core.data.images import Colour, Depth, ImagePreparation, read_colour, read_depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.data.two_cameras import DepthCamera, PairPreparation
from magic_core.errors import DataError
from magic_core.geometry import Camera


class StoredFrame(Protocol):
    """One frame of a recording: when, where, and how to read its images."""

    @property
    def timestamp_s(self) -> float: ...

    @property
    def world_from_camera(self) -> NDArray[np.float64] | None:
        """Ground truth (4, 4), None where the recording has none for this frame."""
        ...

    @property
    def label(self) -> str:
        """What messages call this frame: the name of its colour image."""
        ...

    @property
    def cameras(self) -> tuple[Camera, Camera] | None:
        """Colour and depth camera of this very frame, where a layout stores one per frame."""
        ...

    def read_colour(self) -> Colour:
        """(h, w, 3) RGB as stored; DataError where it cannot be read."""
        ...

    def read_depth(self, depth_scale: float) -> Depth:
        """(h, w) metres; `depth_scale` units per metre where the file holds units."""
        ...

    def damaged(self) -> list[str]:
        """Names of this frame's files that are missing, empty or cut short."""
        ...


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """A frame that lies on disk as two image files."""

    timestamp_s: float
    colour_path: Path
    depth_path: Path
    world_from_camera: NDArray[np.float64] | None = None
    cameras: tuple[Camera, Camera] | None = None

    @property
    def label(self) -> str:
        return self.colour_path.name

    def read_colour(self) -> Colour:
        return read_colour(self.colour_path)

    def read_depth(self, depth_scale: float) -> Depth:
        return read_depth(self.depth_path, depth_scale)

    def damaged(self) -> list[str]:
        return [path.name for path in (self.colour_path, self.depth_path) if not whole_image(path)]


class FileSequence:
    """A FrameSource that reads stored frames lazily, one at a time."""

    def __init__(
        self,
        name: str,
        files: Sequence[StoredFrame],
        *,
        intrinsics: Intrinsics,
        scale: float = 1.0,
        depth_camera: DepthCamera | None = None,
        deliver: Literal["colour", "depth"] = "colour",
        left_out: int = 0,
    ) -> None:
        self.name = name
        self.files = tuple(files)
        self.intrinsics = intrinsics
        """Of the colour images as stored, and the unit of the depth files."""
        self.depth_camera = depth_camera
        self.left_out = left_out
        """Colour images of the recording that have no depth image, and are therefore not used."""
        self._preparation: ImagePreparation | PairPreparation
        if depth_camera is None:
            self._preparation = ImagePreparation.plan(intrinsics, scale)
        else:
            self._preparation = PairPreparation(
                intrinsics, depth_camera, scale=scale, deliver=deliver
            )
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
        stored = self.files[position]
        colour = stored.read_colour()
        depth = stored.read_depth(self.intrinsics.depth_scale)
        self._check_size(colour.shape[:2], self.intrinsics.camera, f"colour of {stored.label}")
        depth_camera = self.depth_camera.camera if self.depth_camera else self.intrinsics.camera
        self._check_size(depth.shape, depth_camera, f"depth of {stored.label}")
        prepare = self._preparation
        if stored.cameras is not None and isinstance(prepare, PairPreparation):
            colour = prepare.colour(colour, stored.cameras[0])
            depth = prepare.depth(depth, stored.cameras[1])
        else:
            colour, depth = prepare.colour(colour), prepare.depth(depth)
        return Frame(
            index=position,
            timestamp_s=stored.timestamp_s,
            colour=colour,
            depth=depth,
            world_from_camera=stored.world_from_camera,
        )

    def _check_size(self, shape: tuple[int, ...], camera: Camera, what: str) -> None:
        if shape != (camera.height, camera.width):
            raise DataError(
                f"{self.name}: {what} has {shape[1]}x{shape[0]} pixels, but the intrinsics are for "
                f"{camera.width}x{camera.height}; correct the intrinsics, or register depth to "
                "colour so that both have one size"
            )


_Stored = TypeVar("_Stored", bound=StoredFrame)


def subsample(
    files: Sequence[_Stored], *, stride: int = 1, max_frames: int | None = None
) -> tuple[_Stored, ...]:
    """Every `stride`-th frame, at most `max_frames` of them."""
    if stride < 1:
        raise DataError(f"stride {stride}: expected 1 (every frame) or more")
    if max_frames is not None and max_frames < 1:
        raise DataError(f"max_frames {max_frames}: expected 1 or more, or nothing for all")
    return tuple(files[::stride][:max_frames])


def require_increasing_times(files: Sequence[StoredFrame], *, where: Path) -> None:
    """Raise DataError where time stands still or runs back."""
    for before, after in pairwise(files):
        if not after.timestamp_s > before.timestamp_s:
            raise DataError(
                f"{where}: {after.label} at {after.timestamp_s:.6f} s follows "
                f"{before.timestamp_s:.6f} s; timestamps must increase. Sort the list, and drop "
                "doubled lines."
            )


def whole_image(path: Path) -> bool:
    """Whether an image file is there and ends as its format ends; decoded only in doubt."""
    try:
        with path.open("rb") as file:
            head = file.read(8)
            size = file.seek(0, 2)
            file.seek(max(0, size - 64))
            tail = file.read()
    except OSError:
        return False
    if head.startswith(b"\x89PNG"):
        return b"IEND" in tail or _decodes(path)
    if head.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in tail or _decodes(path)
    return size > 0


def _decodes(path: Path) -> bool:
    """Whether a whole image comes out; some cameras append data of their own to their files."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, SyntaxError, ValueError):
        return False
    return True
