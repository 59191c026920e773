"""Live progress of a run: bars with rate and remaining time on a terminal, plain lines in a log."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from magic_cli.output import console
from magic_core.data import FrameSource

PLAIN_INTERVAL_S = 15.0
"""In a log, one line about all agents this often."""


class RunProgress:
    """Shows how far the agents and the merge are."""

    def __init__(self, sources: list[FrameSource]) -> None:
        self._bars: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._figures: dict[str, dict] = {}
        self._lengths = {source.name: len(source) for source in sources}
        self._last_line_s = self._started_s = time.monotonic()
        self._merge_stage = ""

    def __enter__(self) -> Self:
        if console.is_terminal:
            self._bars = Progress(
                TextColumn("{task.description:<10}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
                console=console,
            )
            self._bars.start()
            for name, length in self._lengths.items():
                self._tasks[name] = self._bars.add_task(name, total=length, rate="", note="")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        console.print(text, markup=False)

    def agent(self, name: str, figures: dict) -> None:
        """An agent's newest figures."""
        self._figures[name] = figures
        if self._bars is not None:
            task = self._bars.tasks[self._bars.task_ids.index(self._tasks[name])]
            rate = f"{task.speed:.1f} frames/s" if task.speed else ""
            self._bars.update(
                self._tasks[name],
                completed=figures.get("frames", 0),
                rate=rate,
                note=f"{figures.get('submaps', 0)} sub-maps, revision {figures.get('revision', 0)}"
                + (f", {figures['dropped']} dropped" if figures.get("dropped") else ""),
            )
        elif time.monotonic() - self._last_line_s > PLAIN_INTERVAL_S:
            self._last_line_s = time.monotonic()
            self.say(self._line(self._last_line_s - self._started_s))

    def agent_ended(self, name: str, state: str) -> None:
        """An agent's process ended."""
        if self._bars is None:
            figures = self._figures.get(name, {})
            self.say(f"{name}: {state} after {figures.get('frames', 0)} frames")

    def merge(self, share: float, stage: str) -> None:
        """How far the merge is."""
        if self._bars is None:
            if stage != self._merge_stage:
                self.say(f"map: {stage}")
        else:
            if "map" not in self._tasks:
                self._tasks["map"] = self._bars.add_task("map", total=100, rate="", note=stage)
            self._bars.update(self._tasks["map"], completed=round(100 * share), note=stage)
        self._merge_stage = stage

    def _line(self, elapsed_s: float) -> str:
        """All agents in one line: how far, how fast, how long still."""
        parts = [
            f"{name} {self._figures.get(name, {}).get('frames', 0)}/{length}"
            for name, length in self._lengths.items()
        ]
        revision = max((f.get("revision", 0) for f in self._figures.values()), default=0)
        done = sum(figures.get("frames", 0) for figures in self._figures.values())
        rate = done / max(elapsed_s, 1e-6)
        left_s = (sum(self._lengths.values()) - done) / rate if done else float("inf")
        left = f", {_minutes(left_s)} left" if np.isfinite(left_s) else ""
        return (
            f"frames: {', '.join(parts)}; {rate:.1f} frames/s{left}; pose graph revision {revision}"
        )


def _minutes(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
