"""What the page says: figures of the session, its agents, its loops and a keyframe, in words."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from magic_cli.loops import EXPLANATIONS
from magic_cli.viewer.model import SessionView
from magic_core.submap import Keyframe
from magic_core.wire import names
from magic_core.wire.records import LoopCandidate


def summary_text(view: SessionView, shown: int) -> str:
    """One paragraph: revision, counts, and how much of the map the browser has."""
    snapshot = view.snapshot
    if snapshot is None or not view.submaps:
        return f"**{view.session}**: waiting for the first sub-map."
    what = "merged map" if view.merged else "sub-maps"
    verdicts = [loop.verdict for loop in view.loops]
    lines = [
        f"**{view.session}**, pose graph revision {snapshot.revision}",
        f"{len(view.submaps)} sub-maps in {len(snapshot.components)} component(s)",
        f"showing the {what}, {shown:,} Gaussians",
        f"loops: {verdicts.count('ACCEPTED')} accepted ({snapshot.loops_kept} relied on), "
        f"{verdicts.count('REJECTED')} rejected, {verdicts.count('PENDING')} under verification",
    ]
    return "  \n".join(lines)


def agents_text(view: SessionView, *, now: datetime | None = None) -> str:
    """A table: state, when last heard of, what it sent, and whom it shares a map with."""
    if not view.agents:
        return "No agent yet."
    now = now or datetime.now(UTC)
    rows = [
        f"| {names.parse_agent(agent.name)[1]} | {agent.state.lower()} | "
        f"{_ago((now - agent.last_seen_at).total_seconds())} | "
        f"{agent.submap_count} | {_frames(view, agent.name)} | {_map_of(view, agent.name)} |"
        for agent in sorted(view.agents, key=lambda agent: agent.name)
    ]
    head = ["| agent | state | heard of | sub-maps | frames | map |", "|---|---|---|---|---|---|"]
    return "\n".join([*head, *rows])


def _ago(seconds: float) -> str:
    """A time past, in the largest unit that is not nought."""
    for size, unit in ((86_400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{max(0.0, seconds):.0f} s ago"


def _frames(view: SessionView, agent: str) -> int:
    """Frames in the sub-maps that an agent sent."""
    return sum(len(s.path) for n, s in view.submaps.items() if n.startswith(f"{agent}/"))


def _map_of(view: SessionView, agent: str) -> str:
    """Whether an agent's sub-maps lie in one map with those of others."""
    if view.snapshot is None or _frames(view, agent) == 0:
        return ""
    joined = any(agent in c.agents and len(c.agents) > 1 for c in view.snapshot.components)
    return "joined" if joined else "alone"


def loop_title(loop: LoopCandidate) -> str:
    """`agent_0/1 - agent_2/3: REJECTED, FREE_SPACE`."""
    end = "" if loop.verdict == "ACCEPTED" else f", {loop.reason}"
    return f"{short(loop.source)} - {short(loop.target)}: {loop.verdict}{end}"


def loop_text(loop: LoopCandidate, *, plain: bool = False) -> str:
    """A candidate's verdict and figures, as Markdown or plain text."""
    used = " and relied on" if loop.kept else ""
    set_aside = loop.verdict == "ACCEPTED" and not loop.kept
    reason = "SET_ASIDE_BY_SOLVER" if set_aside else loop.reason
    lines = [
        f"similarity {loop.similarity:.2f}, overlap {loop.overlap:.2f}",
        f"fitness {loop.fitness:.2f}, RMSE {1e3 * loop.rmse_m:.1f} mm, {loop.inliers} inliers",
        f"verified in {loop.verify_seconds:.2f} s",
    ]
    if plain:
        return ", ".join(lines)
    head = [f"**{loop.verdict}{used}**: `{reason}`", EXPLANATIONS.get(reason, "")]
    return "  \n".join([line for line in (*head, *lines) if line])


def keyframe_text(agent: str, keyframe: Keyframe, rendered: NDArray[np.uint8]) -> str:
    """Which frame it is, and how well the map shows it."""
    error = np.square(keyframe.colour.astype(np.float64) - rendered).mean()
    psnr_db = 10.0 * np.log10(255.0**2 / max(float(error), 1e-6))
    return (
        f"Frame {keyframe.frame_index} of {agent}, {keyframe.timestamp_s:.2f} s  \n"
        f"rendered against real: PSNR {psnr_db:.1f} dB"
    )


def short(name: str) -> str:
    """`agent/3` of a sub-map's resource name."""
    _, agent, index = names.parse_submap(name)
    return f"{agent}/{index}"
