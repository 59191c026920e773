"""Writers of the layouts that cameras and datasets use, written from their documentation alone.

Each takes frames of the small flat, whose geometry is exact, and stores them as the layout does;
none shares code with the reader that is tested on it.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import cv2
import lzfse
import numpy as np

from magic_core.data import Frame
from magic_core.geometry import Camera

ARKIT = np.diag([1.0, -1.0, -1.0, 1.0])


def bgr(frame: Frame, times: int = 1) -> np.ndarray:
    """The frame's colour for OpenCV, enlarged."""
    image = cv2.cvtColor(frame.colour, cv2.COLOR_RGB2BGR)
    size = (image.shape[1] * times, image.shape[0] * times)
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) if times > 1 else image


def millimetres(frame: Frame) -> np.ndarray:
    """The frame's depth as 16-bit millimetres."""
    return np.rint(frame.depth * 1000).astype(np.uint16)


def enlarged(camera: Camera, times: int) -> Camera:
    """The camera of an image that many times larger."""
    return camera.scaled(times)


def write_scannet(folder: Path, frames: list[Frame], camera: Camera, *, enlarge: int = 2) -> Path:
    """color/, depth/, pose/, intrinsic/ as SensReader's export_* functions write them."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for k, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"color/{k}.jpg"), bgr(frame, enlarge))
        cv2.imwrite(str(folder / f"depth/{k}.png"), millimetres(frame))
        np.savetxt(folder / f"pose/{k}.txt", frame.world_from_camera, fmt="%f")
    for kind, lens in (("color", enlarged(camera, enlarge)), ("depth", camera)):
        matrix = np.eye(4)
        matrix[:3, :3] = lens.matrix
        np.savetxt(folder / f"intrinsic/intrinsic_{kind}.txt", matrix, fmt="%f")
        np.savetxt(folder / f"intrinsic/extrinsic_{kind}.txt", np.eye(4), fmt="%f")
    return folder


def write_scannetpp(folder: Path, frames: list[Frame], camera: Camera) -> Path:
    """SCENE/iphone/ as the toolkit's extraction leaves it: colour large, LiDAR depth small."""
    (folder / "iphone" / "rgb").mkdir(parents=True)
    (folder / "iphone" / "depth").mkdir()
    content = {}
    for k, frame in enumerate(frames):
        name = f"frame_{k:06d}"
        cv2.imwrite(str(folder / f"iphone/rgb/{name}.jpg"), bgr(frame, 2))
        cv2.imwrite(str(folder / f"iphone/depth/{name}.png"), millimetres(frame))
        content[name] = {
            "timestamp": 5000.5 + k / 60,
            "pose": (frame.world_from_camera @ ARKIT).tolist(),
            "aligned_pose": frame.world_from_camera.tolist(),
            "intrinsic": enlarged(camera, 2).matrix.tolist(),
            "imu": [],
        }
    (folder / "iphone" / "pose_intrinsic_imu.json").write_text(json.dumps(content))
    return folder


def write_record3d(path: Path, frames: list[Frame], camera: Camera, *, change=None) -> Path:
    """An .r3d file: a zip of `metadata` and rgbd/N.jpg, N.depth and N.conf."""
    colour = enlarged(camera, 2)
    metadata = {
        "w": colour.width, "h": colour.height, "dw": camera.width, "dh": camera.height, "fps": 60,
        "K": [colour.fx, 0, 0, 0, colour.fy, 0, colour.cx, colour.cy, 1],
        "perFrameIntrinsicCoeffs": [[colour.fx, colour.fy, colour.cx, colour.cy] for _ in frames],
        "frameTimestamps": [0.25 + k / 60 for k in range(len(frames))],
        "poses": [_xyzw_xyz(frame.world_from_camera @ ARKIT) for frame in frames],
        "initPose": [0, 0, 0, 1, 0, 0, 0],
    }  # fmt: skip
    if change:
        change(metadata)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for k, frame in enumerate(frames):
            archive.writestr(f"rgbd/{k}.jpg", cv2.imencode(".jpg", bgr(frame, 2))[1].tobytes())
            depth = np.where(frame.depth > 0, frame.depth, np.nan).astype("<f4")
            archive.writestr(f"rgbd/{k}.depth", lzfse.compress(depth.tobytes()))
            confidence = np.full(frame.depth.shape, 2, np.uint8)
            confidence[:, :4] = 0
            archive.writestr(f"rgbd/{k}.conf", lzfse.compress(confidence.tobytes()))
    return path


def write_plain(folder: Path, frames: list[Frame], camera: Camera, *, names=None) -> Path:
    """rgb/ + depth/ + cam_params.json + traj.txt."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    names = names or [f"{k}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(folder / f"rgb/{name}.png"), bgr(frame))
        cv2.imwrite(str(folder / f"depth/{name}.png"), millimetres(frame))
    np.savetxt(folder / "traj.txt", [frame.world_from_camera.ravel() for frame in frames])
    values = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy,
              "cx": camera.cx, "cy": camera.cy, "scale": 1000, "fps": 15}  # fmt: skip
    (folder / "cam_params.json").write_text(json.dumps({"camera": values}))
    return folder


def _xyzw_xyz(pose: np.ndarray) -> list[float]:
    """[qx, qy, qz, qw, x, y, z] by the eigenvector of Bar-Itzhack's matrix."""
    r = pose[:3, :3]
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    _, vectors = np.linalg.eigh(k / 3)
    return [*vectors[:, -1].tolist(), *pose[:3, 3].tolist()]
