"""The Replica layout: `results/frame%06d.jpg`, `results/depth%06d.png`, `traj.txt`.

`traj.txt` has one line per frame: 16 numbers, world_from_camera row by row, OpenCV axes. It may be
absent (no ground truth). `cam_params.json` lies beside it or in a folder above.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.data.intrinsics import CAMERA_FILE, Intrinsics, find_intrinsics, read_intrinsics
from magic_core.data.sequence import FileSequence, FrameFiles, subsample
from magic_core.errors import DataError

TRAJECTORY_FILE = "traj.txt"
RESULTS_FOLDER = "results"
_COLOUR_NAME = re.compile(r"frame(\d+)\.(?:jpg|jpeg|png)$", re.IGNORECASE)


def is_replica(folder: Path) -> bool:
    """Whether `folder` holds one camera's recording in this layout."""
    return (folder / RESULTS_FOLDER).is_dir()


def open_replica(
    folder: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> FileSequence:
    """One recording in the Replica layout; DataError says what is missing and what to do."""
    intrinsics = _intrinsics(folder)
    files = subsample(replica_files(folder, intrinsics), stride=stride, max_frames=max_frames)
    return FileSequence(name, files, intrinsics=intrinsics, scale=scale)


def replica_files(folder: Path, intrinsics: Intrinsics) -> list[FrameFiles]:
    """The frames of the recording in order of their number; times come from the frame rate."""
    numbered = _numbered_colours(folder / RESULTS_FOLDER)
    poses = _poses(folder, numbers=[number for number, _ in numbered])
    files = []
    for (number, colour), pose in zip(numbered, poses, strict=True):
        digits = re.sub(r"\D", "", colour.stem)
        depth = colour.with_name(f"depth{digits}.png")
        if not depth.is_file():
            raise DataError(
                f"{depth}: missing, although {colour.name} exists; every colour image needs its "
                "depth image. Copy it again, or remove the colour image."
            )
        files.append(FrameFiles(number / intrinsics.rate_hz, colour, depth, pose))
    return files


def read_replica_trajectory(path: Path) -> NDArray[np.float64]:
    """(n, 4, 4) world_from_camera of a traj.txt; unreadable numbers raise DataError."""
    try:
        rows = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}; expected 16 numbers per line") from error
    if rows.shape[1] != 16:
        raise DataError(
            f"{path}: {rows.shape[1]} numbers per line; expected 16, the 4x4 world_from_camera "
            "row by row"
        )
    return rows.reshape(-1, 4, 4)


def _intrinsics(folder: Path) -> Intrinsics:
    path = find_intrinsics(folder)
    if path is None:
        raise DataError(
            f"{folder}: no {CAMERA_FILE} there or in the two folders above; write one: "
            '{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}, scale = depth units per metre'
        )
    return read_intrinsics(path)


def _numbered_colours(results: Path) -> list[tuple[int, Path]]:
    if not results.is_dir():
        raise DataError(f"{results}: no such folder; expected frame%06d.jpg and depth%06d.png")
    matches = ((_COLOUR_NAME.match(path.name), path) for path in results.iterdir())
    found = sorted((int(match.group(1)), path) for match, path in matches if match)
    if not found:
        raise DataError(f"{results}: no frame%06d.jpg or .png; check the path")
    return found


def _poses(folder: Path, *, numbers: list[int]) -> list[NDArray[np.float64] | None]:
    path = folder / TRAJECTORY_FILE
    if not path.is_file():
        return [None] * len(numbers)
    trajectory = read_replica_trajectory(path)
    if len(trajectory) == len(numbers):
        rows = range(len(numbers))
    elif numbers[-1] < len(trajectory):
        rows = numbers  # an excerpt of a recording whose trajectory is complete
    else:
        raise DataError(
            f"{path}: {len(trajectory)} poses for {len(numbers)} frames (last number "
            f"{numbers[-1]}); expected one line per frame, or no file at all"
        )
    poses = (trajectory[row] for row in rows)
    return [pose if np.isfinite(pose).all() else None for pose in poses]
