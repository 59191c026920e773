"""A plain folder: colour images, depth images and a cam_params.json.

    rgb/NAME.jpg or .png       (or color/, colour/, images/)
    depth/NAME.png             16-bit, `scale` units per metre
    cam_params.json            {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale", "fps"}}
    traj.txt                   optional ground truth: 16 numbers per image, world_from_camera

Images belong together where their names, or the last numbers in them, are equal. Names that are
times (`1311868164.363181`, or 19 digits of nanoseconds) give the timestamps; `fps` does otherwise.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.data.image_folders import (
    COLOUR_SUFFIXES,
    DEPTH_SUFFIXES,
    images_in,
    paired,
    require_pairs,
)
from magic_core.data.intrinsics import CAMERA_FILE, find_intrinsics, read_intrinsics
from magic_core.data.pose_files import known_pose
from magic_core.data.replica import TRAJECTORY_FILE, read_replica_trajectory
from magic_core.data.sequence import (
    FileSequence,
    FrameFiles,
    require_increasing_times,
    subsample,
)
from magic_core.errors import DataError

COLOUR_FOLDERS = ("rgb", "color", "colour", "images")
DEPTH_FOLDER = "depth"
_SECONDS = re.compile(r"\d{1,12}\.\d+$")
_NANOSECONDS = re.compile(r"\d{16,19}$")


def is_plain(folder: Path) -> bool:
    """Whether `folder` holds one camera's recording in this layout."""
    return _colour_folder(folder) is not None and (folder / DEPTH_FOLDER).is_dir()


def open_plain(
    folder: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> FileSequence:
    """One plain folder; DataError says what is missing and what to do."""
    path = find_intrinsics(folder)
    if path is None:
        raise DataError(
            f"{folder}: no {CAMERA_FILE} there or in the two folders above; write one: "
            '{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}, scale = depth units per metre'
        )
    intrinsics = read_intrinsics(path)
    files, left_out = _files(folder, intrinsics.rate_hz)
    files = subsample(files, stride=stride, max_frames=max_frames)
    return FileSequence(name, files, intrinsics=intrinsics, scale=scale, left_out=left_out)


def _files(folder: Path, rate_hz: float) -> tuple[list[FrameFiles], int]:
    colour_folder = _colour_folder(folder)
    if colour_folder is None:
        raise DataError(f"{folder}: no {' or '.join(COLOUR_FOLDERS)} folder; check the path")
    colour = images_in(colour_folder, COLOUR_SUFFIXES)
    depth_folder = folder / DEPTH_FOLDER
    pairs = paired(colour, images_in(depth_folder, DEPTH_SUFFIXES))
    require_pairs(pairs, colour=colour_folder, depth=depth_folder)
    places = {name: place for place, name in enumerate(colour)}
    times = _times(list(colour), rate_hz)
    poses = _poses(folder, len(colour))
    files = [
        FrameFiles(times[places[name]], colour_path, depth_path, poses[places[name]])
        for name, colour_path, depth_path in pairs
    ]
    require_increasing_times(files, where=colour_folder)
    return files, len(colour) - len(files)


def _times(names: list[str], rate_hz: float) -> list[float]:
    """Seconds from the names where all of them are times, from the frame rate otherwise."""
    if all(_SECONDS.match(name) for name in names):
        return [float(name) for name in names]
    if all(_NANOSECONDS.match(name) for name in names):
        return [int(name) / 1e9 for name in names]
    return [place / rate_hz for place in range(len(names))]


def _poses(folder: Path, count: int) -> list[NDArray[np.float64] | None]:
    path = folder / TRAJECTORY_FILE
    if not path.is_file():
        return [None] * count
    trajectory = read_replica_trajectory(path)
    if len(trajectory) != count:
        raise DataError(
            f"{path}: {len(trajectory)} poses for {count} colour images; expected one line per "
            "image, or no file at all"
        )
    return [known_pose(pose) for pose in trajectory]


def _colour_folder(folder: Path) -> Path | None:
    return next((folder / name for name in COLOUR_FOLDERS if (folder / name).is_dir()), None)
