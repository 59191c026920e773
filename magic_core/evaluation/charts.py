"""The charts of a report: trajectories from above, time per frame."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magic_core.evaluation.records import AgentReport, LoopRecord
from magic_core.evaluation.trajectory import Trajectory
from magic_core.evaluation.vantage import PlanFrame

AGENT_COLOURS = (
    "#0f8b8d", "#e2711d", "#7b5ea7", "#c9304f", "#4c8c2b", "#2b6cb0", "#94612c", "#5c6670",
)  # fmt: skip
BRIGHT_AGENT_COLOURS = (
    "#25c9cc", "#ff9b42", "#b79cff", "#ff6b88", "#93d660", "#6fb1ff", "#e0b070", "#b9c2cb",
)  # fmt: skip
_INK, _FAINT, _GRID = "#23282e", "#9aa3ab", "#e8ebee"
_ACCEPTED, _REJECTED = "#2e9e4f", "#d64545"
_DPI = 150

Plan = NDArray[np.float64]


def colour_of(number: int, *, on_dark: bool = False) -> str:
    """The colour of the n-th agent."""
    palette = BRIGHT_AGENT_COLOURS if on_dark else AGENT_COLOURS
    return palette[number % len(palette)]


def png(figure: Figure) -> bytes:
    """A figure as PNG bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, facecolor="white")
    return buffer.getvalue()


def trajectory_chart(
    before: Mapping[str, Trajectory],
    after: Mapping[str, Trajectory],
    truth: Mapping[str, Trajectory],
    *,
    frame: PlanFrame,
    loops: Sequence[LoopRecord],
    anchors_before: Mapping[str, Plan],
    anchors_after: Mapping[str, Plan],
) -> bytes:
    """Two plans: odometry alone, and corrected with the loops that did it (PNG bytes).

    Trajectories are in the world of the largest component; anchors map sub-map names to (3,).
    """
    names = sorted({*before, *after})
    everything = [frame.plan(t.positions) for t in (*before.values(), *after.values())]
    figure, left, right, limits = _two_plans(np.concatenate(everything))
    for axes, title, tracks, anchors in (
        (left, "Tracked: odometry alone", before, anchors_before),
        (right, "Corrected by the pose graph", after, anchors_after),
    ):
        _prepare(axes, title)
        axes.set_aspect("equal")
        axes.set(xlim=limits[:, 0], ylim=limits[:, 1])
        _draw_loops(axes, frame, loops, anchors)
        for name in sorted(truth):
            xy = frame.plan(truth[name].positions)
            axes.plot(*xy.T, color=_INK, lw=0.9, ls=(0, (4, 3)), alpha=0.75, zorder=5)
        for number, name in enumerate(names):
            if name in tracks:
                _draw_track(axes, frame.plan(tracks[name].positions), colour_of(number))
        for place in anchors.values():
            axes.plot(*frame.plan(place[None])[0], "o", ms=3.4, mfc="white", mec=_INK, mew=0.8,
                      zorder=7)  # fmt: skip
    _legend(figure, names, has_truth=bool(truth), loops=loops)
    return png(figure)


def _two_plans(points: Plan) -> tuple[Figure, Axes, Axes, Plan]:
    """A figure of two equal plans, side by side or, where the place is long, one above the other.

    Returns the figure, its axes and their limits (2, 2): low and high of x and y.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, 0.3 * float((high - low).max()) + 0.2)
    centre, span = 0.5 * (low + high), 1.12 * span
    limits = np.stack([centre - 0.5 * span, centre + 0.5 * span])
    ratio = float(span[1] / span[0])
    stacked = ratio < 0.55
    panel = 11.4 if stacked else 5.7
    height = np.clip(panel * ratio, 2.2, 8.0)
    figure = Figure(figsize=(12.4, (2 if stacked else 1) * (height + 0.75) + 0.5))
    figure.set_layout_engine("constrained")
    first, second = figure.subplots(*((2, 1) if stacked else (1, 2)))
    return figure, first, second, limits


def _prepare(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=12, color=_INK, loc="left", pad=8)
    axes.grid(color=_GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9, colors=_FAINT, length=0)
    axes.set_xlabel("metres", fontsize=9, color=_FAINT)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_track(axes: Axes, xy: Plan, colour: str) -> None:
    axes.plot(*xy.T, color=colour, lw=2.1, solid_capstyle="round", zorder=6)
    axes.plot(*xy[0], marker="s", ms=6.5, color=colour, mec="white", mew=1.2, zorder=8)
    axes.plot(*xy[-1], marker=">", ms=7.5, color=colour, mec="white", mew=1.2, zorder=8)


def _draw_loops(
    axes: Axes, frame: PlanFrame, loops: Sequence[LoopRecord], anchors: Mapping[str, Plan]
) -> None:
    """Accepted loops in green above, rejected ones faint red below."""
    for accepted, colour, alpha, width in (
        (False, _REJECTED, 0.22, 0.8),
        (True, _ACCEPTED, 0.8, 1.3),
    ):
        ends = [
            frame.plan(np.stack([anchors[loop.source], anchors[loop.target]]))
            for loop in loops
            if loop.accepted == accepted and loop.source in anchors and loop.target in anchors
        ]
        axes.add_collection(
            LineCollection(ends, colors=colour, alpha=alpha, linewidths=width, zorder=3 + accepted)
        )


def _legend(
    figure: Figure, names: Sequence[str], *, has_truth: bool, loops: Sequence[LoopRecord]
) -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=colour_of(n), lw=2.4, label=name) for n, name in enumerate(names)
    ]
    if has_truth:
        entries.append(Line2D([], [], color=_INK, lw=1, ls=(0, (4, 3)), label="ground truth"))
    accepted = sum(loop.accepted for loop in loops)
    if accepted:
        entries.append(Line2D([], [], color=_ACCEPTED, lw=1.6, label=f"accepted loop ({accepted})"))
    if len(loops) > accepted:
        entries.append(
            Line2D([], [], color=_REJECTED, lw=1.2, alpha=0.5,
                   label=f"rejected loop ({len(loops) - accepted})")
        )  # fmt: skip
    entries.append(
        Line2D([], [], ls="", marker="o", mfc="white", mec=_INK, ms=4, label="sub-map anchor")
    )
    figure.legend(
        handles=entries, loc="outside lower center", ncols=min(len(entries), 8), frameon=False,
        fontsize=9.5, labelcolor=_INK,
    )  # fmt: skip


def timing_chart(reports: Sequence[AgentReport]) -> bytes:
    """Tracking and mapping time of every frame, one row per agent (PNG bytes)."""
    figure = Figure(figsize=(12.4, 1.2 + 1.35 * len(reports)), layout="constrained")
    rows = np.atleast_1d(figure.subplots(len(reports), 1, sharex=True))
    for number, (axes, report) in enumerate(zip(rows, reports, strict=True)):
        _prepare(axes, "")
        axes.set_xlabel("")
        mapping, tracking = np.array(report.mapping_ms), np.array(report.tracking_ms)
        axes.bar(np.arange(len(mapping)), mapping, width=1.0, color=_FAINT, alpha=0.55)
        axes.plot(tracking, color=colour_of(number), lw=1.3)
        axes.set_ylabel(f"{report.agent}\nms", fontsize=9, color=_INK)
        high = np.percentile(np.concatenate([mapping, tracking, [1.0]]), 99)
        axes.set_ylim(0, 1.15 * float(high))
        axes.margins(x=0.005)
    rows[-1].set_xlabel("frame", fontsize=9, color=_FAINT)
    rows[0].set_title("Line: tracking. Grey: mapping.", fontsize=10, color=_INK, loc="left")
    return png(figure)
