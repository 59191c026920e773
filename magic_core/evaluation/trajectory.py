"""Trajectories and their files: TUM and KITTI."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import CorruptData, InvalidInput
from magic_core.geometry import se3
from magic_core.geometry.axes import reoriented_poses


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Camera poses over time in one world frame that the owner names."""

    timestamps_s: NDArray[np.float64]  # (n,)
    world_from_camera: NDArray[np.float64]  # (n, 4, 4)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @classmethod
    def from_poses(cls, timed_poses: Iterable[tuple[float, ArrayLike]]) -> Trajectory:
        """From (timestamp in seconds, (4, 4) pose) pairs, in the order given."""
        pairs = list(timed_poses)
        times = np.array([time for time, _ in pairs], dtype=np.float64)
        poses = np.array([pose for _, pose in pairs], dtype=np.float64).reshape(-1, 4, 4)
        return cls(times, poses)

    @property
    def positions(self) -> NDArray[np.float64]:
        """(n, 3) camera centres in the world, metres."""
        return self.world_from_camera[:, :3, 3]

    @property
    def path_length_m(self) -> float:
        """Length of the path travelled."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def transformed(self, target_from_world: ArrayLike) -> Trajectory:
        """The same motion in another frame."""
        return Trajectory(self.timestamps_s, np.asarray(target_from_world) @ self.world_from_camera)

    def reoriented(self, matrix: ArrayLike) -> Trajectory:
        """The same motion with other axes (3, 3) of both the world and the camera."""
        return Trajectory(self.timestamps_s, reoriented_poses(self.world_from_camera, matrix))

    def select(self, index: NDArray) -> Trajectory:
        """The poses of a boolean mask (n,) or an index array."""
        return Trajectory(self.timestamps_s[index], self.world_from_camera[index])


def write_tum(path: Path | str, trajectory: Trajectory) -> Path:
    """Write `t x y z qx qy qz qw` per line (this format alone puts w last)."""
    lines = ["# timestamp_s tx ty tz qx qy qz qw (world_from_camera, metres)"]
    for time, pose in zip(trajectory.timestamps_s, trajectory.world_from_camera, strict=True):
        w, x, y, z = se3.quaternion_from_rotation(pose[:3, :3])
        numbers = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], x, y, z, w))
        lines.append(f"{time:.6f} {numbers}")
    path = Path(path)
    path.write_text("\n".join(lines) + "\n")
    return path


def read_tum(path: Path | str) -> Trajectory:
    """Read a TUM trajectory file; CorruptData says which file does not parse."""
    rows = _read_rows(path, columns=8, expectation="t tx ty tz qx qy qz qw")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        poses[:, :3, :3] = se3.rotation_from_quaternion(rows[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = rows[:, 1:4]
    return Trajectory(rows[:, 0].copy(), poses)


def write_kitti(path: Path | str, trajectory: Trajectory) -> Path:
    """Write the first three rows of each pose, 12 numbers per line; times are not stored."""
    rows = trajectory.world_from_camera[:, :3, :].reshape(-1, 12)
    path = Path(path)
    path.write_text("".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))
    return path


def read_kitti(path: Path | str, *, timestamps_s: ArrayLike) -> Trajectory:
    """Read a KITTI pose file; its times must be given, one per line."""
    rows = _read_rows(path, columns=12, expectation="12 numbers, the rows of a 3x4 pose")
    times = np.asarray(timestamps_s, dtype=np.float64)
    if times.shape != (len(rows),):
        raise InvalidInput.field("timestamps_s", f"{times.shape} for {len(rows)} poses")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :] = rows.reshape(-1, 3, 4)
    return Trajectory(times, poses)


def _read_rows(path: Path | str, *, columns: int, expectation: str) -> NDArray[np.float64]:
    try:
        lines = [line.split() for line in Path(path).read_text().splitlines()]
        rows = [line for line in lines if line and not line[0].startswith("#")]
        values = np.array(rows, dtype=np.float64).reshape(-1, columns)
    except (OSError, ValueError) as error:
        raise CorruptData(f"{path}: {error}; expected {expectation} per line") from error
    if len(values) != len(rows) or not np.isfinite(values).all():
        raise CorruptData(f"{path}: expected {expectation} per line, all finite")
    return values
