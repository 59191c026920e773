"""`magic bench agent DATASET --threads N`: frames per second of one whole agent.

Tracking, mapping, hand-over, place descriptor and encoding of sub-maps, with reading, on N cores;
every recording of the dataset by itself, one after the other. Run it on an idle machine.

Examples:
  magic bench agent DATASET --threads 2
  magic bench agent DATASET --threads 1 --frames 100 --json
"""

from __future__ import annotations

from dataclasses import dataclass

from tyro.conf import Positional

from magic_agent.config import AgentConfig
from magic_cli.options import parse
from magic_cli.output import console, print_json, table


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentBenchmark(AgentConfig):
    """Options of `magic bench agent`."""

    dataset: Positional[str]
    """Dataset: one recording, or one per agent."""
    threads: int = 1
    """Cores that the process may use."""
    scale: float = 0.5
    """Process images at this fraction of their size."""
    frames: int | None = None
    """Use only so many frames of each recording."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its table."""
    config = parse(AgentBenchmark, arguments, prog="magic bench agent", description=__doc__ or "")
    config.validate()
    from magic_agent import throughput

    result = throughput.run(
        config.dataset,
        threads=config.threads,
        scale=config.scale,
        frames=config.frames,
        config=config,
        progress=lambda text: console.print(text, markup=False),
    )
    console.print(_table(result))
    if config.json:
        print_json(result)
    return 0


def _table(result: dict):
    agents = result["agents"]
    rows = [
        ["frames (lost)", *(f"{a['frames']} ({a['lost_frames']})" for a in agents.values())],
        ["keyframes / sub-maps", *(f"{a['keyframes']} / {a['submaps']}" for a in agents.values())],
        ["frames/s", *(f"{a['fps']:.2f}" for a in agents.values())],
        ["  of the slowest sub-map", *(f"{a['slowest_submap_fps']:.2f}" for a in agents.values())],
        ["CPU ms/frame", *(f"{a['cpu_ms_per_frame']:.1f}" for a in agents.values())],
        ["ms/frame", *(f"{a['wall_ms_per_frame']:.1f}" for a in agents.values())],
    ]
    for stage in next(iter(agents.values()))["stages_ms_per_frame"]:
        values = (a["stages_ms_per_frame"][stage] for a in agents.values())
        rows.append([f"  {stage}", *(f"{value:.1f}" for value in values)])
    cores = "all" if result["cores"] is None else result["cores"]
    title = f"One agent at a time, {result['threads']} threads on {cores} cores"
    return table(title, ["", *agents], rows)
