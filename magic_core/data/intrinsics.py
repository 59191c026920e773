"""Intrinsics of a recording: the camera, the unit of its depth files and its lens distortion."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magic_core.errors import DataError, InvalidInput
from magic_core.geometry import Camera

CAMERA_FILE = "cam_params.json"
_EXAMPLE = (
    '{"camera": {"w": 640, "h": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, '
    '"scale": 1000.0}}'
)


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """What must be known to turn the files of a recording into metric RGB-D frames."""

    camera: Camera
    """The camera of the files as stored."""
    depth_scale: float
    """Units of the 16-bit depth files per metre, for example 1000 for millimetres."""
    distortion: tuple[float, ...] = ()
    """OpenCV's (k1, k2, p1, p2, k3); empty = the images are already undistorted."""
    rate_hz: float = 30.0
    """Frames per second, used where the layout stores no timestamps."""


def find_intrinsics(folder: Path, *, levels: int = 2) -> Path | None:
    """The cam_params.json of a recording: in its folder or up to `levels` folders above."""
    folder = folder.resolve()
    for place in (folder, *folder.parents[:levels]):
        if (place / CAMERA_FILE).is_file():
            return place / CAMERA_FILE
    return None


def read_intrinsics(path: Path, *, default_depth_scale: float | None = None) -> Intrinsics:
    """Read a cam_params.json; DataError names the key that is missing or impossible."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON ({error}); expected {_EXAMPLE}") from error
    values = content.get("camera", content) if isinstance(content, dict) else {}
    if default_depth_scale is not None:
        values = {"scale": default_depth_scale, **values}
    missing = [key for key in ("w", "h", "fx", "fy", "cx", "cy", "scale") if key not in values]
    if missing:
        raise DataError(f"{path}: no {', '.join(missing)} under 'camera'; expected {_EXAMPLE}")
    return _from_values(path, values)


def write_intrinsics(path: Path, intrinsics: Intrinsics) -> None:
    """Write a cam_params.json that `read_intrinsics` reads back."""
    camera = intrinsics.camera
    values: dict[str, Any] = {
        "w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx, "cy": camera.cy, "scale": intrinsics.depth_scale,
        "fps": intrinsics.rate_hz,
    }  # fmt: skip
    if intrinsics.distortion:
        values["distortion"] = list(intrinsics.distortion)
    path.write_text(json.dumps({"camera": values}, indent=1) + "\n")


def _from_values(path: Path, values: dict[str, Any]) -> Intrinsics:
    try:
        camera = Camera(
            width=int(values["w"]),
            height=int(values["h"]),
            fx=float(values["fx"]),
            fy=float(values["fy"]),
            cx=float(values["cx"]),
            cy=float(values["cy"]),
        )
        camera.validate()
        depth_scale = float(values["scale"])
        rate_hz = float(values.get("fps", 30.0))
        distortion = tuple(float(value) for value in values.get("distortion", ()))
    except (TypeError, ValueError, InvalidInput) as error:
        raise DataError(f"{path}: {error}; expected numbers as in {_EXAMPLE}") from error
    if not depth_scale > 0 or not rate_hz > 0:
        raise DataError(
            f"{path}: scale {depth_scale}, fps {rate_hz}; both must be > 0 "
            "(scale: depth-file units per metre, 1000 for millimetres)"
        )
    if len(distortion) not in (0, 4, 5, 8):
        raise DataError(
            f"{path}: {len(distortion)} distortion coefficients; expected OpenCV's 4, 5 or 8 "
            "(k1, k2, p1, p2, k3, ...)"
        )
    return Intrinsics(camera, depth_scale, distortion, rate_hz)
