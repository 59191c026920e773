"""The TUM RGB-D layout: `rgb.txt`, `depth.txt` and, where known, `groundtruth.txt`.

Colour, depth and ground truth are associated by nearest time, as the benchmark's own tools do
(Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012). The
calibrations are those the benchmark publishes; a cam_params.json beside rgb.txt overrides them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.data.association import associate
from magic_core.data.intrinsics import CAMERA_FILE, Intrinsics, read_intrinsics
from magic_core.data.sequence import FileSequence, FrameFiles, require_increasing_times, subsample
from magic_core.errors import DataError
from magic_core.geometry import Camera, se3

COLOUR_LIST = "rgb.txt"
DEPTH_LIST = "depth.txt"
GROUND_TRUTH_LIST = "groundtruth.txt"
MAX_TIME_DIFFERENCE_S = 0.020
DEPTH_SCALE = 5000.0

_FREIBURG = {
    1: Intrinsics(
        Camera(width=640, height=480, fx=517.3, fy=516.5, cx=318.6, cy=255.3),
        DEPTH_SCALE,
        (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    ),
    2: Intrinsics(
        Camera(width=640, height=480, fx=520.9, fy=521.0, cx=325.1, cy=249.7),
        DEPTH_SCALE,
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    ),
    3: Intrinsics(
        Camera(width=640, height=480, fx=535.4, fy=539.2, cx=320.1, cy=247.6), DEPTH_SCALE
    ),
}


def is_tum(folder: Path) -> bool:
    """Whether `folder` holds one camera's recording in this layout."""
    return (folder / COLOUR_LIST).is_file()


def open_tum(
    folder: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> FileSequence:
    """One recording in the TUM RGB-D layout; distortion is removed from colour and depth."""
    intrinsics = tum_intrinsics(folder)
    files, left_out = tum_files(folder)
    files = subsample(files, stride=stride, max_frames=max_frames)
    return FileSequence(name, files, intrinsics=intrinsics, scale=scale, left_out=left_out)


def tum_intrinsics(folder: Path) -> Intrinsics:
    """cam_params.json of the folder, else the published calibration its name asks for."""
    if (folder / CAMERA_FILE).is_file():
        return read_intrinsics(folder / CAMERA_FILE, default_depth_scale=DEPTH_SCALE)
    name = folder.resolve().name.lower()
    for number, intrinsics in _FREIBURG.items():
        if f"freiburg{number}" in name or f"fr{number}" in name:
            return intrinsics
    raise DataError(
        f"{folder}: no {CAMERA_FILE}, and the folder's name does not say freiburg1, 2 or 3; write "
        f"a {CAMERA_FILE} beside {COLOUR_LIST} with w, h, fx, fy, cx, cy, optionally scale "
        "(default 5000) and distortion [k1, k2, p1, p2, k3]"
    )


def tum_files(folder: Path) -> tuple[list[FrameFiles], int]:
    """Frames that have both images, in time order, and how many colour images have no depth."""
    colour_times, colour_names = _read_list(folder / COLOUR_LIST)
    depth_times, depth_names = _read_list(folder / DEPTH_LIST)
    poses = _ground_truth(folder, colour_times)
    pairs = associate(colour_times, depth_times, max_difference_s=MAX_TIME_DIFFERENCE_S)
    if not len(pairs):
        raise DataError(
            f"{folder}: no colour image has a depth image within "
            f"{1000 * MAX_TIME_DIFFERENCE_S:.0f} ms; check that {COLOUR_LIST} and {DEPTH_LIST} "
            "use one clock, in seconds"
        )
    files = [
        FrameFiles(
            float(colour_times[i]), folder / colour_names[i], folder / depth_names[j], poses[i]
        )
        for i, j in pairs
    ]
    require_increasing_times(files, where=folder / COLOUR_LIST)
    return files, len(colour_times) - len(files)


def _read_list(path: Path) -> tuple[NDArray[np.float64], list[str]]:
    if not path.is_file():
        raise DataError(f"{path}: missing; expected lines of `timestamp filename`")
    rows = [line.split() for line in path.read_text().splitlines()]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    try:
        return np.array([float(row[0]) for row in rows]), [row[1] for row in rows]
    except (ValueError, IndexError) as error:
        raise DataError(f"{path}: {error}; expected lines of `timestamp filename`") from error


def _ground_truth(folder: Path, times_s: NDArray[np.float64]) -> list[NDArray[np.float64] | None]:
    poses: list[NDArray[np.float64] | None] = [None] * len(times_s)
    path = folder / GROUND_TRUTH_LIST
    if not path.is_file():
        return poses
    try:
        rows = np.loadtxt(path, dtype=np.float64, ndmin=2)
        truth = [(row[1:4], row[[7, 4, 5, 6]]) for row in rows]
    except (ValueError, IndexError) as error:
        raise DataError(f"{path}: {error}; expected `t tx ty tz qx qy qz qw` per line") from error
    nearest = np.abs(rows[:, 0, None] - times_s).argmin(axis=0)
    for i, row in enumerate(nearest):
        if abs(rows[row, 0] - times_s[i]) <= MAX_TIME_DIFFERENCE_S:
            position, quaternion = truth[row]
            rotation = se3.rotation_from_quaternion(quaternion)
            poses[i] = se3.from_rotation_translation(rotation, position)
    return poses
