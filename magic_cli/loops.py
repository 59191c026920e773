"""`magic loops RUN`: every loop candidate, what was measured of it, and why it was believed or not.

RUN is a run folder, or the address of a live server (then --session names the session). `agent_0 3
@5` is sub-map 3 of agent_0 where its keyframe 5 looks like the other side, instead of its anchor.

Examples:
  magic loops runs/demo
  magic loops runs/demo --verdict rejected --reason LOW_OVERLAP
  magic loops runs/office --agent robot_1 --between --json
  magic loops 192.168.1.20:50051 --session kitchen
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.evaluation.records import LoopRecord, agent_of, index_of
from magic_core.wire import ClientCredentials

EXPLANATIONS = {
    "ACCEPTED": "verified, and kept by the pose graph",
    "PENDING": "waits for its verification",
    "SET_ASIDE_BY_SOLVER": "verified, but the other loops and odometry contradict it",
    "NO_HYPOTHESIS": "no registration method found how the two images could fit",
    "FEW_INLIERS": "too few points agree on one motion (--registration.min-inliers)",
    "LOW_OVERLAP": "the images share too little surface (--registration.min-overlap)",
    "LOW_FITNESS": "too few of the shared points coincide (--registration.min-fitness)",
    "HIGH_RMSE": "coinciding points lie too far apart (--registration.max-rmse-m)",
    "FREE_SPACE": "one image sees through what the other shows (--registration.max-free-space)",
    "TEXTURE_MISMATCH": "shapes fit, patterns do not (--registration.min-texture-correlation)",
    "COLOUR_MISMATCH": "shapes fit, colours do not (--registration.min-colour-correlation)",
    "DEGENERATE": "a bare wall or floor, free to slide (--registration.min-information)",
    "VERIFICATION_FAILED": "verification failed with an error; the server's log says which",
}
"""What the server's reason codes mean, and the setting that decides."""

NO_CANDIDATES = (
    "No candidates: no two places looked alike. Were the same places seen twice? Then lower "
    "--candidates.min-similarity, or take a stronger image model (--places-model)."
)


@dataclass(frozen=True, slots=True)
class LoopsConfig:
    """Options of `magic loops`."""

    run: Positional[str]
    """Run folder, or HOST:PORT of a server."""
    session: str = "default"
    """Session on the server."""
    verdict: Literal["all", "accepted", "rejected", "pending"] = "all"
    """Only candidates with this verdict."""
    reason: str | None = None
    """Only candidates with this reason."""
    agent: str | None = None
    """Only candidates of this agent."""
    between: bool = False
    """Only candidates between two agents."""
    min_similarity: float = -1.0
    """Only candidates that look at least this much alike."""
    sort: Literal["similarity", "overlap", "fitness", "rmse", "name"] = "similarity"
    """Order of the table; best first."""
    credentials: ClientCredentials = field(default_factory=ClientCredentials)
    """Encryption and token of a server's address."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Print the candidates; 0 also when there are none."""
    config = parse(LoopsConfig, arguments, prog="magic loops", description=__doc__ or "")
    every = read_loops(config)
    chosen = selected(every, config)
    console.print(table(f"Loop candidates of {config.run}", COLUMNS, [_row(c) for c in chosen]))
    _explain(chosen, every)
    if config.json:
        candidates = [dataclasses.asdict(loop) for loop in chosen]
        reasons = dict(Counter(loop.reason for loop in chosen))
        print_json({"total": len(every), "reasons": reasons, "candidates": candidates})
    return 0


def read_loops(config: LoopsConfig) -> list[LoopRecord]:
    """From the run folder, or else from the server at that address."""
    if Path(config.run).exists() or ":" not in config.run:
        from magic_core.evaluation import RunFolder

        return RunFolder(config.run).read_loops()
    return asyncio.run(_live_loops(config))


def selected(loops: list[LoopRecord], config: LoopsConfig) -> list[LoopRecord]:
    """The candidates that pass every filter, in the wanted order."""
    found = [
        loop
        for loop in loops
        if config.verdict in ("all", loop.verdict)
        and (config.reason is None or loop.reason.upper() == config.reason.upper())
        and (config.agent is None or config.agent in _agents(loop))
        and (not config.between or len(_agents(loop)) == 2)
        and loop.similarity >= config.min_similarity
    ]
    order = {
        "similarity": lambda loop: -loop.similarity,
        "overlap": lambda loop: -loop.overlap,
        "fitness": lambda loop: -loop.fitness,
        "rmse": lambda loop: (not loop.inliers, loop.rmse_m),  # not measured comes last
        "name": lambda loop: (_place(loop.source), _place(loop.target)),
    }[config.sort]
    return sorted(found, key=order)


COLUMNS = ["source", "target", "similarity", "overlap", "fitness", "RMSE", "inliers", "verdict",
           "reason"]  # fmt: skip
_COLOURS = {"accepted": "green", "rejected": "red", "pending": "yellow"}


def _row(loop: LoopRecord) -> list[str]:
    verdict = f"[{_COLOURS.get(loop.verdict, 'white')}]{loop.verdict}[/]"
    if not (loop.inliers or loop.fitness or loop.overlap):
        figures = ["-", "-", "-", "-"]  # never registered
    else:
        figures = [f"{loop.overlap:.2f}", f"{loop.fitness:.2f}", f"{100 * loop.rmse_m:.1f} cm",
                   str(loop.inliers)]  # fmt: skip
    names = [
        _short(loop.source, loop.source_keyframe),
        _short(loop.target, loop.target_keyframe),
    ]
    return [*names, f"{loop.similarity:.3f}", *figures, verdict, loop.reason]


def _explain(chosen: list[LoopRecord], every: list[LoopRecord]) -> None:
    if not every:
        console.print(NO_CANDIDATES, markup=False)
        return
    counts = Counter(loop.reason for loop in chosen)
    for reason, count in counts.most_common():
        meaning = EXPLANATIONS.get(reason, "")
        console.print(f"{count:4d}  {reason or 'no reason given'}: {meaning}", markup=False)
    if len(chosen) < len(every):
        console.print(f"{len(chosen)} of {len(every)} candidates shown", markup=False)


async def _live_loops(config: LoopsConfig) -> list[LoopRecord]:
    from magic_agent.client import ClientConfig, MagicClient
    from magic_cli.collect import loop_record

    async with MagicClient(config.run, ClientConfig(credentials=config.credentials)) as client:
        answer = await client.list_loops(config.session)
    return [
        dataclasses.replace(loop_record(loop), verdict="pending")
        if loop.verdict == "PENDING"
        else loop_record(loop)
        for loop in answer.candidates
    ]


def _agents(loop: LoopRecord) -> set[str]:
    return {agent_of(loop.source), agent_of(loop.target)}


def _place(name: str) -> tuple[str, int]:
    return agent_of(name), index_of(name)


def _short(name: str, keyframe: int) -> str:
    """Agent and sub-map; `@n` where keyframe n looks like the other side instead of the anchor."""
    short = f"{agent_of(name)} {index_of(name)}"
    return f"{short} @{keyframe}" if keyframe else short
