"""What is wrong with a dataset, in words: the checks behind `magic check-data`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from magic_core.data.consistency import DOCUMENTED, fits
from magic_core.data.discovery import layout_name, open_dataset, recordings
from magic_core.data.frame import Frame
from magic_core.data.images import read_depth
from magic_core.data.intrinsics import find_intrinsics
from magic_core.data.sequence import FileSequence
from magic_core.errors import DataError
from magic_core.geometry import se3

Status = Literal["ok", "warn", "fail"]

_SAMPLES = 8
_NEIGHBOURS = 5  # frames between the two of a pair that are compared
_COMMON_SCALES = (1000.0, 5000.0, 6553.5, 10000.0, 4000.0, 256.0)
_MAX_LISTED = 5
_SENSOR_NOISE = 0.008  # relative difference of depth that needs no other explanation


@dataclass(frozen=True, slots=True)
class Finding:
    """The outcome of one check."""

    name: str
    """What was checked, with the agent where there are several."""
    status: Status
    detail: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty when all is well."""


@dataclass(frozen=True, slots=True)
class DatasetReport:
    """Everything that was found in a dataset."""

    path: Path
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing failed; warnings do not count."""
        return all(finding.status != "fail" for finding in self.findings)


def check_dataset(path: Path | str) -> DatasetReport:
    """Check layout, files, intrinsics, depth unit, times, motion and pose convention.

    Never raises for what is wrong with the data: that is what the findings are for.
    """
    folder = Path(path).expanduser()
    try:
        found = recordings(folder)
    except DataError as error:
        return DatasetReport(folder, (_failed("layout", error),))
    findings = [_layout(found)]
    for name, recording in found:
        prefix = f"{name}: " if len(found) > 1 else ""
        findings += [
            Finding(prefix + finding.name, finding.status, finding.detail, finding.remedy)
            for finding in _check_recording(recording)
        ]
    return DatasetReport(folder, tuple(findings))


def _layout(found: list[tuple[str, Path]]) -> Finding:
    layouts = sorted({layout_name(recording) or "?" for _, recording in found})
    names = ", ".join(name for name, _ in found)
    return Finding(
        "layout", "ok", f"{' and '.join(layouts)} layout, {len(found)} agent(s): {names}"
    )


def _check_recording(folder: Path) -> Iterator[Finding]:
    try:
        source = open_dataset(folder)[0]
    except DataError as error:
        yield _failed("opening", error)
        return
    assert isinstance(source, FileSequence)
    files = _files(source)
    yield files
    yield from _intrinsics(folder, source)
    yield _times(source)
    if files.status == "fail":
        return
    try:
        frames = _sample(source)
    except DataError as error:
        yield _failed("images", error)
        return
    yield _colour(frames)
    yield from _depth(source, frames)
    yield from _poses(source)


def _files(source: FileSequence) -> Finding:
    missing = [
        path
        for files in source.files
        for path in (files.colour_path, files.depth_path)
        if not path.is_file() or path.stat().st_size == 0
    ]
    if missing:
        listed = ", ".join(path.name for path in missing[:_MAX_LISTED])
        more = f" and {len(missing) - _MAX_LISTED} more" if len(missing) > _MAX_LISTED else ""
        return Finding("files", "fail", f"{len(missing)} missing or empty: {listed}{more}",
                       "copy them again, or take their frames out of the list")  # fmt: skip
    status: Status = "ok" if len(source) >= 10 else "warn"
    remedy = "" if status == "ok" else "a sub-map wants some tens of frames"
    return Finding("files", status, f"{len(source)} frames, colour and depth each", remedy)


def _intrinsics(folder: Path, source: FileSequence) -> Iterator[Finding]:
    camera = source.intrinsics.camera
    origin = find_intrinsics(folder)
    field = float(np.rad2deg(2 * np.arctan(camera.width / (2 * camera.fx))))
    detail = (
        f"{camera.width}x{camera.height}, f {camera.fx:.1f} {camera.fy:.1f}, "
        f"c {camera.cx:.1f} {camera.cy:.1f}, {field:.0f} degrees wide, from "
        f"{origin.name if origin else 'the published calibration'}"
    )
    if source.intrinsics.distortion:
        detail += ", distortion removed"
    wrong = []
    if not 30 <= field <= 130:
        wrong.append(f"{field:.0f} degrees is no usual field of view")
    if abs(camera.fx / camera.fy - 1) > 0.1:
        wrong.append("fx and fy differ by more than 10 %")
    off_x = abs(camera.cx / camera.width - 0.5)
    off_y = abs(camera.cy / camera.height - 0.5)
    if max(off_x, off_y) > 0.15:
        wrong.append("the principal point is far from the middle")
    remedy = "calibrate for this image size: f and c scale with it"
    if wrong:
        yield Finding("intrinsics", "warn", f"{detail}; {'; '.join(wrong)}", remedy)
    else:
        yield Finding("intrinsics", "ok", detail)


def _times(source: FileSequence) -> Finding:
    times = np.array([files.timestamp_s for files in source.files])
    steps = np.diff(times)
    if not len(steps):
        return Finding("timestamps", "warn", "one frame only", "record more")
    if (steps <= 0).any():
        return Finding("timestamps", "fail", f"{int((steps <= 0).sum())} do not increase",
                       "sort the list by time and drop doubled lines")  # fmt: skip
    usual = float(np.median(steps))
    gaps = int((steps > 5 * usual).sum())
    detail = f"{1 / usual:.1f} Hz, {times[-1] - times[0]:.1f} s"
    if gaps:
        return Finding("timestamps", "warn", f"{detail}, {gaps} gaps of over five frames",
                       "tracking may lose the camera there")  # fmt: skip
    if not 2 <= 1 / usual <= 240:
        return Finding("timestamps", "warn", f"{detail}: no usual frame rate",
                       "are the times in seconds?")  # fmt: skip
    return Finding("timestamps", "ok", detail)


def _sample(source: FileSequence) -> list[Frame]:
    """A few frames spread over the recording."""
    places = np.unique(np.linspace(0, len(source) - 1, _SAMPLES).astype(int))
    return [source[int(place)] for place in places]


def _colour(frames: list[Frame]) -> Finding:
    mean = float(np.mean([frame.colour.mean() for frame in frames]))
    spread = float(np.mean([frame.colour.std() for frame in frames]))
    detail = f"mean {mean:.0f}, contrast {spread:.0f} of 255"
    if spread < 8 or not 15 < mean < 245:
        return Finding("colour", "warn", f"{detail}: nearly blank", "check exposure and decoding")
    return Finding("colour", "ok", detail)


def _depth(source: FileSequence, frames: list[Frame]) -> Iterator[Finding]:
    scale = source.intrinsics.depth_scale
    known = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    share = len(known) / sum(frame.depth.size for frame in frames)
    if share < 0.02:
        yield Finding("depth", "fail", f"readings in {100 * share:.1f} % of the pixels",
                      "depth files are empty or not 16-bit; write uint16 PNGs")  # fmt: skip
        return
    low, middle, high = (float(value) for value in np.percentile(known, (1, 50, 99)))
    detail = (
        f"readings in {100 * share:.0f} % of the pixels, {low:.2f} to {high:.2f} m, median "
        f"{middle:.2f} m with scale {scale:g}"
    )
    if share < 0.25:
        yield Finding("depth", "warn", detail, "few readings: glass, sunlight, or too near?")
    elif 0.7 <= middle <= 12 and low >= 0.12 and high <= 40:
        yield Finding("depth", "ok", detail)
    else:
        yield _doubtful_unit(source, detail, middle)


def _doubtful_unit(source: FileSequence, detail: str, middle_m: float) -> Finding:
    raw = read_depth(source.files[0].depth_path, 1.0)
    units = float(np.median(raw[raw > 0])) if (raw > 0).any() else 0.0
    likely = [f"{scale:g} ({units / scale:.2f} m)" for scale in _COMMON_SCALES
              if 0.5 <= units / scale <= 8]  # fmt: skip
    status: Status = "fail" if not 0.25 <= middle_m <= 30 else "warn"
    remedy = (
        f"WRONG DEPTH SCALE? The files hold about {units:.0f} units. `scale` in cam_params.json is "
        "units per metre; " + (f"likely {' or '.join(likely)}" if likely else "none fits")
    )
    return Finding("depth", status, detail, remedy)


def _poses(source: FileSequence) -> Iterator[Finding]:
    posed = [files.world_from_camera for files in source.files]
    known = np.array([pose for pose in posed if pose is not None])
    if not len(known):
        yield Finding("ground truth", "ok", "none: trajectories will not be measured")
        return
    rotations = known[:, :3, :3]
    skew = float(np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max())
    if skew > 1e-2 or (np.linalg.det(rotations) < 0).any():
        yield Finding("ground truth", "fail", f"rotations are off by {skew:.2g}",
                      "expected 4x4 rigid transforms, row by row")  # fmt: skip
        return
    yield _motion(source, known)
    yield _convention(source)


def _motion(source: FileSequence, poses: np.ndarray) -> Finding:
    relative = se3.inverse(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(relative[:, :3, 3], axis=1) if len(relative) else np.zeros(1)
    turn = np.array([se3.rotation_angle(motion) for motion in relative] or [0.0])
    fast_step, fast_turn = np.percentile(step, 95), np.rad2deg(np.percentile(turn, 95))
    detail = (
        f"{len(poses)} of {len(source)} frames; per frame {1000 * np.median(step):.0f} mm and "
        f"{np.rad2deg(np.median(turn)):.2f} degrees, 95 % below {1000 * fast_step:.0f} mm and "
        f"{fast_turn:.1f} degrees"
    )
    if fast_step > 0.15 or fast_turn > 10:
        return Finding("motion", "warn", detail, "fast for tracking: use every frame, or go slower")
    return Finding("motion", "ok", detail)


def _convention(source: FileSequence) -> Finding:
    """Carry depth between neighbouring frames by their poses, read in every usual way."""
    name = "pose convention"
    starts = np.unique(np.linspace(0, max(len(source) - 1, 0), _SAMPLES).astype(int))
    ranked = []
    for start in starts:
        places = range(int(start), min(int(start) + 3 * _NEIGHBOURS, len(source)), _NEIGHBOURS)
        ranked.append(fits([source[place] for place in places], source.camera))
    errors: dict[tuple[str, float], list[float]] = {}
    for fit in (fit for group in ranked for fit in group):
        errors.setdefault((fit.convention, fit.depth_factor), []).append(fit.error)
    if not errors:
        return Finding(name, "warn", "the camera hardly moves between frames: not checked")
    medians = {key: float(np.median(values)) for key, values in errors.items()}
    (convention, factor), best = min(medians.items(), key=lambda item: item[1])
    ours = medians[(DOCUMENTED, 1.0)]
    detail = f"carried depth differs by {100 * ours:.1f} % when read as {DOCUMENTED}"
    if ours <= _SENSOR_NOISE or best > 0.5 * ours:
        if ours <= 0.06:
            return Finding(name, "ok", detail)
        return Finding(name, "warn", detail, "poses, intrinsics and depth do not fit each other: "
                       "do poses belong to these frames, in this order?")  # fmt: skip
    better = f"{detail}; {100 * best:.1f} % "
    if convention != DOCUMENTED:
        return Finding(name, "fail", f"{better}as {convention}",
                       f"the poses are {convention}: convert them to {DOCUMENTED}")  # fmt: skip
    scale = source.intrinsics.depth_scale / factor
    return Finding(name, "fail", f"{better}with depth times {factor:g}",
                   f"WRONG DEPTH SCALE: set `scale` to {scale:g} units per metre")  # fmt: skip


def _failed(name: str, error: DataError) -> Finding:
    found, _, remedy = error.message.partition("; ")
    return Finding(name, "fail", found, remedy)
