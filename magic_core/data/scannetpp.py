"""The iPhone recording of a ScanNet++ scene, extracted by the dataset's toolkit.

    iphone/rgb/frame_000000.jpg        1920x1440
    iphone/depth/frame_000000.png      256x192 LiDAR, uint16 millimetres
    iphone/pose_intrinsic_imu.json     per frame: timestamp, intrinsic (3x3, of the colour image),
                                       aligned_pose (4x4 world_from_camera, OpenCV axes), pose ...

The dataset is shipped as rgb.mkv and depth.bin; its toolkit (`python -m iphone.prepare_iphone_data`
with extract_rgb and extract_depth) writes the images. The path may be the scene or its iphone/
folder. (Yeshwanth et al., "ScanNet++: A High-Fidelity Dataset of 3D Indoor Scenes", ICCV 2023.)
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from magic_core.data.image_folders import COLOUR_SUFFIXES, colour_size, images_in, natural_key
from magic_core.data.images import read_depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.data.pose_files import (
    camera_from_matrix,
    median_camera,
    pose_from_values,
    resized_camera,
)
from magic_core.data.sequence import (
    FileSequence,
    FrameFiles,
    require_increasing_times,
    subsample,
)
from magic_core.data.two_cameras import DepthCamera
from magic_core.errors import DataError
from magic_core.geometry import Camera

METADATA_FILE = "pose_intrinsic_imu.json"
DEPTH_SCALE = 1000.0
RATE_HZ = 60.0


def is_scannetpp(folder: Path) -> bool:
    """Whether `folder` is a ScanNet++ scene with an iPhone recording, or its iphone/ folder."""
    return _metadata_path(folder) is not None


def open_scannetpp(
    folder: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> FileSequence:
    """One iPhone recording; frames are delivered in the colour camera (1920x1440 at scale 1)."""
    path = _metadata_path(folder)
    if path is None:
        raise DataError(f"{folder}: no {METADATA_FILE} there or under iphone/; check the path")
    entries = _entries(path)
    colour = images_in(path.parent / "rgb", COLOUR_SUFFIXES)
    depth = images_in(path.parent / "depth", (".png",))
    _require_extracted(path.parent, colour, depth)
    both = [key for key in entries if key in colour and key in depth]
    if not both:
        raise DataError(f"{path}: none of its frames has both rgb/ and depth/; extract both again")
    size = colour_size(colour[both[0]])
    height, width = read_depth(depth[both[0]], DEPTH_SCALE).shape
    cameras = {key: _camera(path, key, entries[key], size) for key in both}
    files = [
        FrameFiles(
            _time(entries[key], place),
            colour[key],
            depth[key],
            _pose(path, key, entries[key]),
            (cameras[key], resized_camera(cameras[key], width=width, height=height)),
        )
        for place, key in enumerate(both)
    ]
    require_increasing_times(files, where=path)
    camera = median_camera(list(cameras.values()))
    return FileSequence(
        name,
        subsample(files, stride=stride, max_frames=max_frames),
        intrinsics=Intrinsics(camera, DEPTH_SCALE, rate_hz=RATE_HZ),
        scale=scale,
        depth_camera=DepthCamera(resized_camera(camera, width=width, height=height)),
        left_out=len(colour) - len(files),
    )


def _metadata_path(folder: Path) -> Path | None:
    places = (folder / METADATA_FILE, folder / "iphone" / METADATA_FILE)
    return next((path for path in places if path.is_file()), None)


def _entries(path: Path) -> dict[str, dict[str, Any]]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON ({error}); download it again") from error
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()):
        raise DataError(f"{path}: expected one object per frame, as in {{'frame_000000': {{...}}}}")
    return {key: content[key] for key in sorted(content, key=natural_key)}


def _require_extracted(folder: Path, colour: dict[str, Path], depth: dict[str, Path]) -> None:
    for images, packed, kind in ((colour, "rgb.mkv", "rgb"), (depth, "depth.bin", "depth")):
        if not images:
            there = f", only {packed}" if (folder / packed).is_file() else ""
            raise DataError(
                f"{folder / kind}: no images{there}; extract them with the ScanNet++ toolkit: "
                f"python -m iphone.prepare_iphone_data with extract_{kind}: true"
            )


def _camera(path: Path, key: str, entry: dict[str, Any], size: tuple[int, int]) -> Camera:
    try:
        matrix = np.asarray(entry["intrinsic"], dtype=np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: {key}: intrinsic {error!r}; expected a 3x3 matrix") from error
    return camera_from_matrix(matrix, width=size[0], height=size[1], where=f"{path}: {key}")


def _pose(path: Path, key: str, entry: dict[str, Any]):
    values = entry.get("aligned_pose", entry.get("pose"))
    return pose_from_values(values, where=f"{path}: {key}: pose")


def _time(entry: dict[str, Any], place: int) -> float:
    try:
        return float(entry.get("timestamp", place / RATE_HZ))
    except (TypeError, ValueError):
        return place / RATE_HZ
