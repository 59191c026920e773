"""What is wrong with a dataset, in words: the checks behind `magic check-data`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from magic_core.data.check_calibration import check_depth, check_intrinsics
from magic_core.data.check_poses import check_poses
from magic_core.data.discovery import (
    REALSENSE_SCHEME,
    ROSBAG_SCHEME,
    layout_of,
    open_dataset,
    recordings,
)
from magic_core.data.findings import DatasetReport, Finding, Status
from magic_core.data.frame import Frame
from magic_core.data.sequence import FileSequence
from magic_core.errors import DataError

_SAMPLES = 8
_MAX_LISTED = 5
_MANY_LEFT_OUT = 0.05  # share of colour images
_USUAL_RATES_HZ = (2.0, 240.0)
_LONG_GAP = 5  # frames


def check_dataset(path: Path | str, *, read_all: bool = False) -> DatasetReport:
    """Check layout, files, intrinsics, depth unit, times, motion and pose convention.

    With `read_all` every frame is decoded, not a sample of them. Never raises for what is wrong
    with the data: that is what the findings are for.
    """
    try:
        found = _recordings(str(path))
    except DataError as error:
        return DatasetReport(Path(path), (Finding.failed("layout", error),))
    findings = [_layout(found)]
    for name, recording in found:
        prefix = f"{name}: " if len(found) > 1 else ""
        findings += [
            Finding(prefix + finding.name, finding.status, finding.detail, finding.remedy)
            for finding in _check_recording(recording, read_all)
        ]
    return DatasetReport(Path(path), tuple(findings))


def sampled(source: FileSequence, count: int) -> list[int]:
    """Indices of some frames, spread over the recording."""
    return [int(i) for i in np.unique(np.linspace(0, len(source) - 1, count).astype(int))]


def _recordings(address: str) -> list[tuple[str, str]]:
    """(agent name, what opens it) of each recording; of a bag's address, the bag."""
    if address.startswith(REALSENSE_SCHEME):
        raise DataError(
            f"{address}: a live camera; check-data reads recordings: map what it sees at once with "
            "`magic agent realsense:`, or record a bag (`rs-record`) and check that"
        )
    if address.startswith(ROSBAG_SCHEME):
        (source,) = open_dataset(address)
        return [(source.name, address)]
    return [(name, str(path)) for name, path in recordings(Path(address).expanduser())]


def _layout(found: list[tuple[str, str]]) -> Finding:
    names = ", ".join(name for name, _ in found)
    layouts = " and ".join(sorted({_layout_name(recording) for _, recording in found}))
    return Finding("layout", "ok", f"{layouts} layout, {len(found)} agent(s): {names}")


def _layout_name(recording: str) -> str:
    layout = layout_of(Path(recording))
    return layout.name if layout is not None else "ROS bag"


def _check_recording(recording: str, read_all: bool) -> Iterator[Finding]:
    try:
        source = open_dataset(recording)[0]
    except DataError as error:
        yield Finding.failed("opening", error)
        return
    assert isinstance(source, FileSequence)
    files = _files(source)
    yield files
    yield check_intrinsics(Path(recording), source)
    yield _times(source)
    if files.status == "fail":
        return
    try:
        frames = [source[index] for index in sampled(source, _SAMPLES)]
        if read_all:
            for _ in source:
                pass
        yield _colour(frames)
        yield from check_depth(source, frames, layout=_layout_name(recording))
        yield from check_poses(source, layout=_layout_name(recording))
    except DataError as error:
        yield Finding.failed("images", error)


def _files(source: FileSequence) -> Finding:
    damaged = [name for files in source.files for name in files.damaged()]
    if damaged:
        listed = ", ".join(damaged[:_MAX_LISTED])
        more = f" and {len(damaged) - _MAX_LISTED} more" if len(damaged) > _MAX_LISTED else ""
        found = f"{len(damaged)} missing, empty or cut short: {listed}{more}"
        remedy = "copy them again, or take their frames out of the list"
        return Finding("files", "fail", found, remedy)
    detail = f"{len(source)} frames, colour and depth each"
    if source.left_out > _MANY_LEFT_OUT * (source.left_out + len(source)):
        found = f"{detail}; {source.left_out} colour images have no depth"
        remedy = "are depth images missing, or do the clocks of both cameras differ?"
        return Finding("files", "warn", found, remedy)
    if source.left_out:
        detail += f"; {source.left_out} colour images without depth are left out"
    status: Status = "ok" if len(source) >= 10 else "warn"
    remedy = "" if status == "ok" else "a sub-map wants some tens of frames"
    return Finding("files", status, detail, remedy)


def _times(source: FileSequence) -> Finding:
    times = np.array([files.timestamp_s for files in source.files])
    steps = np.diff(times)
    if not len(steps):
        return Finding("timestamps", "warn", "one frame only", "record more")
    if (steps <= 0).any():
        return Finding("timestamps", "fail", f"{int((steps <= 0).sum())} do not increase",
                       "sort the list by time and drop doubled lines")  # fmt: skip
    usual = float(np.median(steps))
    detail = f"{1 / usual:.4g} Hz, {times[-1] - times[0]:.1f} s"
    if not _USUAL_RATES_HZ[0] <= 1 / usual <= _USUAL_RATES_HZ[1]:
        return Finding("timestamps", "warn", f"{detail}: no usual frame rate",
                       "are the times in seconds?")  # fmt: skip
    gaps = np.flatnonzero(steps > _LONG_GAP * usual)
    if len(gaps):
        longest = int(steps.argmax())
        return Finding(
            "timestamps", "warn",
            f"{detail}; {len(gaps)} gap(s) of over {_LONG_GAP} frames, the longest "
            f"{steps[longest]:.2f} s after frame {longest}",
            "tracking may lose the camera there: record without pauses, or split the recording",
        )  # fmt: skip
    return Finding("timestamps", "ok", detail)


def _colour(frames: list[Frame]) -> Finding:
    mean = float(np.mean([frame.colour.mean() for frame in frames]))
    spread = float(np.mean([frame.colour.std() for frame in frames]))
    detail = f"mean {mean:.0f}, contrast {spread:.0f} of 255"
    if spread < 8 or not 15 < mean < 245:
        return Finding("colour", "warn", f"{detail}: nearly blank", "check exposure and decoding")
    return Finding("colour", "ok", detail)
