"""`agents/{agent}/frames.csv`: what tracking said of every frame, written while the agent runs."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, TextIO

from magic_core.errors import CorruptData, NotFound

FILE_NAME = "frames.csv"
State = Literal["first", "ok", "degenerate", "lost", "recovered"]


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame. Figures that tracking did not come to are NaN."""

    frame: int
    timestamp_s: float
    submap: int
    """Index of the sub-map that the frame was tracked in."""
    state: State
    """`first` of a chain; `recovered`: the first that is known again after lost ones."""
    reason: str
    """Why it is lost or degenerate."""
    cost: float
    """Mean robust cost per pixel."""
    inlier_share: float
    """Share of depths seen in both, frame and sub-map, that agree."""
    visible_share: float
    """Share of the image that shows known parts of the sub-map."""
    colour_error: float
    """Standard deviation of colour residuals, in units of full scale."""
    condition_number: float
    """Of the images' information in units of the motion prior; infinite where degenerate."""
    gain: float
    """Brightness correction: gain * frame + bias is as bright as the sub-map."""
    bias: float
    renders: int
    tracking_ms: float
    mapping_ms: float
    keyframe: bool


class FrameLog:
    """Appends frames to the file, each at once: a process that is killed leaves what it saw."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE_NAME
        self._file: TextIO | None = None

    def add(self, record: FrameRecord) -> None:
        """Append one frame. An agent that goes on after a crash overwrites what it sees again."""
        if self._file is None:
            self._file = self._begin(record.frame)
        csv.writer(self._file).writerow(_row(record))
        self._file.flush()

    def close(self) -> None:
        """Close the file; nothing is lost without it."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _begin(self, first_frame: int) -> TextIO:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        earlier: list[FrameRecord] = []
        if first_frame > 0 and self.path.is_file():
            earlier = [r for r in read_frame_records(self.path) if r.frame < first_frame]
        file = self.path.open("w", newline="", encoding="utf-8")
        writer = csv.writer(file)
        writer.writerow(_NAMES)
        writer.writerows(_row(record) for record in earlier)
        return file


def read_frame_records(path: Path) -> list[FrameRecord]:
    """All whole lines of a frames.csv; one that was cut short at the end is left out."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise NotFound(
            f"{path}: no per-frame tracking report there ({error.strerror}); agents write it from "
            "their first frame on"
        ) from error
    records = []
    for number, row in enumerate(rows):
        try:
            records.append(_record(row))
        except (KeyError, TypeError, ValueError) as error:
            if number == len(rows) - 1:
                break
            raise CorruptData(f"{path}: line {number + 2}: {error!r}; expected {_NAMES}") from error
    return records


def state_of(verdict: str | None, *, lost_before: bool) -> State:
    """The state of a frame from the tracker's verdict (None for the first of a chain)."""
    if verdict is None:
        return "first"
    if verdict == "lost":
        return "lost"
    if lost_before:
        return "recovered"
    return "degenerate" if verdict == "degenerate" else "ok"


def lost_stretches(records: Sequence[FrameRecord]) -> list[tuple[FrameRecord, FrameRecord, str]]:
    """(first, last, what came after) of every stretch of lost frames."""
    stretches: list[tuple[FrameRecord, FrameRecord, str]] = []
    begin: FrameRecord | None = None
    for before, record in zip([None, *records], records, strict=False):
        if record.state == "lost":
            begin = begin or record
        elif begin is not None and before is not None:
            after = "a new chain" if record.state == "first" else "recovered"
            stretches.append((begin, before, after))
            begin = None
    if begin is not None:
        stretches.append((begin, records[-1], "the end"))
    return stretches


_NAMES = tuple(item.name for item in fields(FrameRecord))
_WHOLE = ("frame", "submap", "renders")
_WORDS = ("state", "reason")


def _row(record: FrameRecord) -> list[Any]:
    return [_text(value) for value in asdict(record).values()]


def _text(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:.9g}" if abs(value) < 1e8 else f"{value:.6f}"
    return value


def _record(row: dict[str, str]) -> FrameRecord:
    values: dict[str, Any] = {}
    for name in _NAMES:
        text = row[name]
        if text is None:
            raise ValueError(f"no {name}")
        if name in _WORDS:
            values[name] = text
        elif name == "keyframe":
            values[name] = bool(int(text))
        else:
            values[name] = int(text) if name in _WHOLE else float(text)
    return FrameRecord(**values)
