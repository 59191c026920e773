"""Writing any frame source as a dataset in the Replica layout."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from magic_core.data.frame import Frame, FrameSource
from magic_core.data.intrinsics import CAMERA_FILE, Intrinsics, write_intrinsics
from magic_core.data.replica import RESULTS_FOLDER, TRAJECTORY_FILE
from magic_core.errors import DataError

_JPEG_QUALITY = 95
_WRITERS = 2  # frames in work at once; a source's frames may be read from several threads
_MAX_DEPTH_UNITS = np.iinfo(np.uint16).max


def write_replica(
    sources: Sequence[FrameSource],
    folder: Path | str,
    *,
    depth_scale: float = 1000.0,
    rate_hz: float = 30.0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write one sub-folder per source; `open_dataset(folder)` reads the same frames back.

    Colour becomes JPEG, depth 16-bit PNG with `depth_scale` units per metre (readings beyond its
    range become holes), ground truth traj.txt (NaN lines where a frame has none); times follow
    `rate_hz`. `progress(done, total)` is called after each frame. The folder appears only once it
    is complete; one that already holds something is refused.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise DataError(f"{folder}: not empty; choose a new folder, or delete this one first")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    total, start = sum(len(source) for source in sources), 0
    try:
        for source in sources:
            for done in _write_source(source, partial, depth_scale, rate_hz, start):
                if progress is not None:
                    progress(done, total)
            start += len(source)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


def _write_source(
    source: FrameSource, folder: Path, depth_scale: float, rate_hz: float, start: int
) -> Iterator[int]:
    agent = folder / source.name
    (agent / RESULTS_FOLDER).mkdir(parents=True)
    write_intrinsics(agent / CAMERA_FILE, Intrinsics(source.camera, depth_scale, rate_hz=rate_hz))

    def write(number: int) -> str:
        frame = source[number]
        _write_images(agent / RESULTS_FOLDER, number, frame, depth_scale)
        return _pose_line(frame)

    poses = []
    with ThreadPoolExecutor(_WRITERS, thread_name_prefix="write-replica") as pool:
        for line in pool.map(write, range(len(source))):
            poses.append(line)
            yield start + len(poses)
    if any("nan" not in line for line in poses):
        (agent / TRAJECTORY_FILE).write_text("\n".join(poses) + "\n")


def _write_images(results: Path, number: int, frame: Frame, depth_scale: float) -> None:
    units = np.rint(frame.depth.astype(np.float64) * depth_scale)
    units = np.where(units > _MAX_DEPTH_UNITS, 0, units).astype(np.uint16)
    colour = cv2.cvtColor(frame.colour, cv2.COLOR_RGB2BGR)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _write_image(results / f"frame{number:06d}.jpg", colour, quality)
    _write_image(results / f"depth{number:06d}.png", units, [])


def _write_image(path: Path, image: np.ndarray, options: list[int]) -> None:
    if not cv2.imwrite(str(path), image, options):
        raise DataError(f"{path}: cannot be written; check the folder's rights and free space")


def _pose_line(frame: Frame) -> str:
    pose = frame.world_from_camera
    values = np.full(16, np.nan) if pose is None else np.asarray(pose).ravel()
    return " ".join(f"{value:.9f}" for value in values)
