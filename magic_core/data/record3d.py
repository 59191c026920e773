"""A Record3D recording: an .r3d file, or the folder that it was unzipped to.

    metadata          JSON: w, h, dw, dh, K (9 numbers, column by column), fps, frameTimestamps,
                      perFrameIntrinsicCoeffs ([fx, fy, cx, cy] per frame, of the colour image),
                      poses ([qx, qy, qz, qw, x, y, z] per frame, world_from_camera, ARKit's axes)
    rgbd/0.jpg        colour, w x h
    rgbd/0.depth      LZFSE of dw x dh float32 metres, NaN = no reading
    rgbd/0.conf       LZFSE of dw x dh uint8 confidence: 0 low, 1 medium, 2 high; optional

ARKit's camera looks along -z with y up; poses are turned to OpenCV's axes. Readings of low
confidence are dropped. Record3D's "EXR + RGB" export is not read: OpenCV ships without EXR.
"""

from __future__ import annotations

import json
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.data.images import Colour, Depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.data.pose_files import (
    OPENCV_FROM_OPENGL,
    known_pose,
    median_camera,
    pose_from_xyzw,
    resized_camera,
    valid_camera,
)
from magic_core.data.sequence import FileSequence, require_increasing_times, subsample
from magic_core.data.two_cameras import DepthCamera
from magic_core.errors import DataError, InvalidInput
from magic_core.geometry import Camera

SUFFIX = ".r3d"
_METADATA = ("metadata", "metadata.json")
_MIN_CONFIDENCE = 1
_MAX_MEMBER_BYTES = 1 << 28


def is_record3d(path: Path) -> bool:
    """Whether `path` is an .r3d file or a folder that holds what is in one."""
    if path.is_file():
        return path.suffix.lower() == SUFFIX
    frames = (path / "rgbd").is_dir() or any((path / "depth").glob("*.exr"))
    return frames and any((path / name).is_file() for name in _METADATA)


def open_record3d(
    path: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> FileSequence:
    """One recording; frames are delivered in the colour camera."""
    archive = _Archive(path)
    metadata = _Metadata(archive)
    frames, left_out = _frames(archive, metadata)
    require_increasing_times(frames, where=path)
    cameras = [frame.cameras for frame in frames]
    colour = median_camera([pair[0] for pair in cameras])
    width, height = cameras[0][1].width, cameras[0][1].height
    return FileSequence(
        name,
        subsample(frames, stride=stride, max_frames=max_frames),
        intrinsics=Intrinsics(colour, 1.0, rate_hz=metadata.rate_hz),
        scale=scale,
        depth_camera=DepthCamera(resized_camera(colour, width=width, height=height)),
        left_out=left_out,
    )


class _Archive:
    """Members of an .r3d file or of the folder that it was unzipped to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        if path.is_dir():
            self.names = {
                str(member.relative_to(path)) for member in path.rglob("*") if member.is_file()
            }
            return
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError(
                f"{path}: not readable as an .r3d file ({error}); export it from Record3D again"
            ) from error
        self.names = set(self._zip.namelist())

    def size(self, name: str) -> int:
        """Bytes of a member; 0 where it is absent."""
        if name not in self.names:
            return 0
        return self._zip.getinfo(name).file_size if self._zip else (self.path / name).stat().st_size

    def read(self, name: str) -> bytes:
        """The bytes of a member; DataError where they are absent, damaged or far too many."""
        if not 0 < self.size(name) <= _MAX_MEMBER_BYTES:
            raise DataError(f"{self.path}: {name} is missing, empty or too large; export it again")
        try:
            return self._zip.read(name) if self._zip else (self.path / name).read_bytes()
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError(f"{self.path}: {name}: {error}; export it again") from error


class _Metadata:
    """The recording's metadata, checked."""

    def __init__(self, archive: _Archive) -> None:
        name = next((name for name in _METADATA if name in archive.names), None)
        if name is None:
            raise DataError(f"{archive.path}: no metadata in it; export it from Record3D again")
        self.where = f"{archive.path}: {name}"
        try:
            self._values: dict[str, Any] = json.loads(archive.read(name))
            self.width, self.height = int(self._values["w"]), int(self._values["h"])
            self.rate_hz = float(self._values.get("fps") or 60.0)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(
                f"{self.where}: {error!r}; expected JSON with w, h, K and poses"
            ) from error

    def camera(self, index: int) -> Camera:
        """The colour camera of a frame: its own intrinsics, else those of the whole recording."""
        values = self._values
        try:
            per_frame = values.get("perFrameIntrinsicCoeffs") or []
            if index < len(per_frame):
                fx, fy, cx, cy = (float(value) for value in per_frame[index][:4])
            else:
                k = values["K"]
                fx, fy, cx, cy = float(k[0]), float(k[4]), float(k[6]), float(k[7])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise DataError(
                f"{self.where}: no usable intrinsics ({error!r}); expected "
                "perFrameIntrinsicCoeffs with [fx, fy, cx, cy], or K with 9 numbers"
            ) from error
        camera = Camera(self.width, self.height, fx, fy, cx, cy)
        return valid_camera(camera, where=self.where)

    def depth_size(self, values: int) -> tuple[int, int]:
        """(width, height) of depth; old recordings do not say, and have `values` numbers."""
        given = self._values.get("dw"), self._values.get("dh")
        if all(isinstance(size, int) and size > 0 for size in given):
            return int(given[0] or 0), int(given[1] or 0)
        width = round((values * self.width / self.height) ** 0.5)
        if not width or values % width:
            raise DataError(f"{self.where}: no dw and dh; export it with a newer Record3D")
        return width, values // width

    def time(self, index: int) -> float:
        """Seconds of a frame since the start."""
        times = self._values.get("frameTimestamps") or []
        try:
            return float(times[index]) if index < len(times) else index / self.rate_hz
        except (TypeError, ValueError) as error:
            raise DataError(f"{self.where}: frameTimestamps[{index}]: {error}") from error

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """world_from_camera with OpenCV's axes; None where the recording has none."""
        poses = self._values.get("poses") or []
        if index >= len(poses):
            return None
        try:
            values = np.array(poses[index], dtype=np.float64).reshape(7)
            if not np.isfinite(values).all():
                return None
            return known_pose(pose_from_xyzw(values[:4], values[4:]) @ OPENCV_FROM_OPENGL)
        except (TypeError, ValueError, InvalidInput) as error:
            raise DataError(
                f"{self.where}: poses[{index}]: {error}; expected [qx, qy, qz, qw, x, y, z]"
            ) from error


@dataclass(frozen=True, slots=True)
class _Frame:
    """One frame inside the archive."""

    archive: _Archive
    colour_name: str
    depth_name: str
    confidence_name: str
    timestamp_s: float
    world_from_camera: NDArray[np.float64] | None
    cameras: tuple[Camera, Camera]

    @property
    def label(self) -> str:
        return self.colour_name

    def read_colour(self) -> Colour:
        data = np.frombuffer(self.archive.read(self.colour_name), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        if image is None:
            raise DataError(
                f"{self.archive.path}: {self.colour_name} cannot be decoded; export it again"
            )
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)

    def read_depth(self, depth_scale: float) -> Depth:
        where, camera = f"{self.archive.path}: {self.depth_name}", self.cameras[1]
        shape = (camera.height, camera.width)
        packed = self.archive.read(self.depth_name)
        depth = _decompressed(packed, np.dtype("<f4"), shape, where)
        known = np.isfinite(depth) & (depth > 0)
        if self.archive.size(self.confidence_name):
            packed = self.archive.read(self.confidence_name)
            known &= _decompressed(packed, np.dtype("u1"), shape, where) >= _MIN_CONFIDENCE
        return np.where(known, depth, 0).astype(np.float32)

    def damaged(self) -> list[str]:
        return [name for name in (self.colour_name, self.depth_name) if not self.archive.size(name)]


def _frames(archive: _Archive, metadata: _Metadata) -> tuple[list[_Frame], int]:
    """The frames that have colour and depth, and how many have colour alone."""
    stems = [Path(name).stem for name in archive.names if re.fullmatch(r"rgbd/\d+\.jpg", name)]
    numbered = sorted(stems, key=int)
    both = [stem for stem in numbered if f"rgbd/{stem}.depth" in archive.names]
    if not both:
        raise DataError(
            f"{archive.path}: no rgbd/N.jpg with a rgbd/N.depth in it; in Record3D choose the "
            "export format .r3d, not EXR or a video"
        )
    packed = archive.read(f"rgbd/{both[0]}.depth")
    size = metadata.depth_size(len(_unpacked(packed, f"rgbd/{both[0]}.depth")) // 4)
    return [_frame(archive, metadata, stem, size) for stem in both], len(numbered) - len(both)


def _frame(archive: _Archive, metadata: _Metadata, stem: str, size: tuple[int, int]) -> _Frame:
    number = int(stem)
    camera = metadata.camera(number)
    return _Frame(
        archive,
        f"rgbd/{stem}.jpg",
        f"rgbd/{stem}.depth",
        f"rgbd/{stem}.conf",
        metadata.time(number),
        metadata.pose(number),
        (camera, resized_camera(camera, width=size[0], height=size[1])),
    )


def _decompressed(data: bytes, kind: np.dtype, shape: tuple[int, int], where: str) -> NDArray[Any]:
    unpacked = _unpacked(data, where)
    wanted = shape[0] * shape[1] * kind.itemsize
    if len(unpacked) != wanted:
        raise DataError(
            f"{where}: {len(unpacked)} bytes; expected {shape[1]}x{shape[0]} numbers of "
            f"{kind.itemsize} bytes. Export the recording again."
        )
    return np.frombuffer(unpacked, kind).reshape(shape)


def _unpacked(data: bytes, where: str) -> bytes:
    import lzfse

    try:
        return lzfse.decompress(data)
    except (lzfse.error, ValueError, MemoryError) as error:
        raise DataError(
            f"{where}: cannot be decompressed ({error}); export the recording again"
        ) from error
