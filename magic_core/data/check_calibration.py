"""Are a recording's intrinsics and its depth unit plausible?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from magic_core.data.findings import Finding, Status
from magic_core.data.frame import Frame
from magic_core.data.intrinsics import find_intrinsics
from magic_core.data.sequence import FileSequence

OWN_SCALE_LAYOUTS = ("Replica", "TUM RGB-D", "plain folder", "ROS bag")
"""Layouts whose depth unit a cam_params.json sets; the others fix it themselves."""
_COMMON_SCALES = (1000.0, 5000.0, 6553.5, 10000.0, 4000.0, 256.0, 1.0)
_USUAL_FIELD_DEG = (30, 130)
_USUAL_MEDIAN_M = (0.7, 12.0)
_USUAL_NEAREST_M = (0.12, 3.0)  # a hundredth of the readings is nearer; held cameras see something
_USUAL_FARTHEST_M = 40.0
_POSSIBLE_MEDIAN_M = (0.25, 30.0)


def check_intrinsics(recording: Path, source: FileSequence) -> Finding:
    """Field of view, pixel shape and principal point against the image's size."""
    camera = source.intrinsics.camera
    folder = recording if recording.is_dir() else recording.parent
    origin = find_intrinsics(folder, levels=2 if recording.is_dir() else 0)
    field = float(np.rad2deg(2 * np.arctan(camera.width / (2 * camera.fx))))
    detail = (
        f"{camera.width}x{camera.height}, f {camera.fx:.1f} {camera.fy:.1f}, "
        f"c {camera.cx:.1f} {camera.cy:.1f}, {field:.0f} degrees wide, from "
        f"{origin.name if origin else 'the recording or its published calibration'}"
    )
    if source.depth_camera is not None:
        depth = source.depth_camera.camera
        detail += f"; depth {depth.width}x{depth.height}, f {depth.fx:.1f}, brought to one camera"
    if source.intrinsics.distortion:
        detail += "; distortion removed"
    wrong = []
    if not _USUAL_FIELD_DEG[0] <= field <= _USUAL_FIELD_DEG[1]:
        wrong.append(f"{field:.0f} degrees is no usual field of view")
    if abs(camera.fx / camera.fy - 1) > 0.1:
        wrong.append("fx and fy differ by more than 10 %")
    off_x = abs((camera.cx + 0.5) / camera.width - 0.5)
    off_y = abs((camera.cy + 0.5) / camera.height - 0.5)
    if max(off_x, off_y) > 0.15:
        wrong.append("the principal point is far from the middle")
    if wrong:
        remedy = "calibrate for this image size: f and c scale with it"
        return Finding("intrinsics", "warn", f"{detail}; {'; '.join(wrong)}", remedy)
    return Finding("intrinsics", "ok", detail)


def check_depth(source: FileSequence, frames: list[Frame], *, layout: str) -> Iterator[Finding]:
    """Are there readings, and are they as far away as rooms are?"""
    scale = source.intrinsics.depth_scale
    known = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    share = len(known) / sum(frame.depth.size for frame in frames)
    if share < 0.02:
        yield Finding("depth", "fail", f"readings in {100 * share:.1f} % of the pixels",
                      "depth files are empty or not 16-bit; write uint16 PNGs")  # fmt: skip
        return
    low, middle, high = (float(value) for value in np.percentile(known, (1, 50, 99)))
    detail = (
        f"readings in {100 * share:.0f} % of the pixels, {_metres(low)} to {_metres(high)}, median "
        f"{_metres(middle)} with scale {scale:g}"
    )
    usual = (
        _USUAL_MEDIAN_M[0] <= middle <= _USUAL_MEDIAN_M[1]
        and _USUAL_NEAREST_M[0] <= low <= _USUAL_NEAREST_M[1]
        and high <= _USUAL_FARTHEST_M
    )
    if not usual:
        yield _doubtful_unit(source, detail, middle, layout)
    elif share < 0.25:
        yield Finding("depth", "warn", detail, "few readings: glass, sunlight, or too near?")
    else:
        yield Finding("depth", "ok", detail)


def scale_remedy(layout: str, scale: float | str) -> str:
    """Where to set the depth unit of a layout."""
    if layout in OWN_SCALE_LAYOUTS:
        return f"set `scale` in cam_params.json to {scale} units per metre"
    return (
        f"this layout fixes the unit, yours seems to have {scale} units per metre: export it "
        "again, or store it as a plain folder with that `scale` in its cam_params.json"
    )


def _doubtful_unit(source: FileSequence, detail: str, middle_m: float, layout: str) -> Finding:
    units = middle_m * source.intrinsics.depth_scale
    likely = [f"{scale:g} ({units / scale:.2f} m)" for scale in _COMMON_SCALES
              if 0.5 <= units / scale <= 8 and scale != source.intrinsics.depth_scale]  # fmt: skip
    possible = _POSSIBLE_MEDIAN_M[0] <= middle_m <= _POSSIBLE_MEDIAN_M[1]
    status: Status = "warn" if possible else "fail"
    which = " or ".join(likely) or "the true number of"
    remedy = f"WRONG DEPTH SCALE? The median is {units:.4g} units; {scale_remedy(layout, which)}"
    return Finding("depth", status, detail, remedy)


def _metres(value: float) -> str:
    """Metres, or the unit in which an absurd value shows best."""
    if value < 0.1:
        return f"{1000 * value:.2g} mm"
    return f"{value / 1000:.2g} km" if value >= 1000 else f"{value:.2f} m"
