"""A ScanNet scene as the dataset's SensReader exports it.

    color/0.jpg, 1.jpg ...      1296x968
    depth/0.png, 1.png ...      640x480, uint16 millimetres
    pose/0.txt, 1.txt ...       4x4 world_from_camera, OpenCV axes; -inf where tracking was lost
    intrinsic/intrinsic_color.txt, intrinsic_depth.txt, extrinsic_color.txt, extrinsic_depth.txt

Depth is registered to colour but smaller. Frames are delivered in the depth camera, as is usual
for this dataset. ScanNet records 30 frames per second and exports no times. (Dai et al., "ScanNet:
Richly-annotated 3D Reconstructions of Indoor Scenes", CVPR 2017.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from magic_core.data.image_folders import (
    COLOUR_SUFFIXES,
    colour_size,
    images_in,
    last_number,
    paired,
    require_pairs,
)
from magic_core.data.images import read_depth
from magic_core.data.intrinsics import Intrinsics
from magic_core.data.pose_files import camera_from_matrix, read_matrix, read_pose
from magic_core.data.sequence import FileSequence, FrameFiles, subsample
from magic_core.data.two_cameras import DepthCamera
from magic_core.errors import DataError
from magic_core.geometry import Camera

COLOUR_FOLDER, DEPTH_FOLDER, POSE_FOLDER = "color", "depth", "pose"
INTRINSIC_FOLDER = "intrinsic"
DEPTH_SCALE = 1000.0
RATE_HZ = 30.0


def is_scannet(folder: Path) -> bool:
    """Whether `folder` holds one scene in this layout."""
    siblings = (INTRINSIC_FOLDER, POSE_FOLDER)
    return (folder / COLOUR_FOLDER).is_dir() and any((folder / name).is_dir() for name in siblings)


def open_scannet(
    folder: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> FileSequence:
    """One ScanNet export; DataError says what is missing and what to do."""
    files, left_out = scannet_files(folder)
    first = files[0]
    colour = _camera(folder, "color", colour_size(first.colour_path))
    height, width = read_depth(first.depth_path, DEPTH_SCALE).shape
    depth = _camera(folder, "depth", (width, height))
    _require_registered(folder)
    return FileSequence(
        name,
        subsample(files, stride=stride, max_frames=max_frames),
        intrinsics=Intrinsics(colour, DEPTH_SCALE, rate_hz=RATE_HZ),
        scale=scale,
        depth_camera=DepthCamera(depth),
        deliver="depth",
        left_out=left_out,
    )


def scannet_files(folder: Path) -> tuple[list[FrameFiles], int]:
    """The frames in order of their number, and how many colour images have no depth image."""
    colour = images_in(folder / COLOUR_FOLDER, COLOUR_SUFFIXES)
    pairs = paired(colour, images_in(folder / DEPTH_FOLDER, (".png",)))
    require_pairs(pairs, colour=folder / COLOUR_FOLDER, depth=folder / DEPTH_FOLDER)
    files = [
        FrameFiles(
            int(last_number(name) or place) / RATE_HZ,
            colour_path,
            depth_path,
            read_pose(folder / POSE_FOLDER / f"{name}.txt"),
        )
        for place, (name, colour_path, depth_path) in enumerate(pairs)
    ]
    return files, len(colour) - len(files)


def _camera(folder: Path, kind: str, size: tuple[int, int]) -> Camera:
    path = folder / INTRINSIC_FOLDER / f"intrinsic_{kind}.txt"
    if not path.is_file():
        raise DataError(
            f"{path}: missing; export it with SensReader's --export_intrinsics, or write the 4x4 "
            f"matrix of the {kind} camera there"
        )
    return camera_from_matrix(read_matrix(path, (4, 4)), width=size[0], height=size[1], where=path)


def _require_registered(folder: Path) -> None:
    """ScanNet's extrinsics are identities; anything else would need depth moved to colour first."""
    for kind in ("color", "depth"):
        path = folder / INTRINSIC_FOLDER / f"extrinsic_{kind}.txt"
        if path.is_file() and not np.allclose(read_matrix(path, (4, 4)), np.eye(4), atol=1e-3):
            raise DataError(
                f"{path}: not the identity, so depth is not registered to colour; register it "
                "first, or delete the file if that is already done"
            )
