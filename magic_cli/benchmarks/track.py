"""`magic bench track DATASET`: accuracy and speed of tracking, without loop closure.

Runs the whole local SLAM of every agent once per solver on the same frames. `--ablation` runs each
pose initialisation, pyramid depth and part of the tracker in turn instead, as the paper's table.

Examples:
  magic bench track DATASET --scale 0.5 --solvers gn,adam --frames 60
  magic bench track DATASET --solvers gn --seeds 0,1,2
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro
from tyro.conf import Positional

from magic_agent.slam_config import SlamConfig
from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class TrackBenchmark:
    """Options of `magic bench track`."""

    dataset: Positional[str]
    """Dataset with ground truth."""
    scale: float = 0.5
    """Process images at this fraction of their size."""
    frames: int | None = None
    """Use only so many frames of each agent."""
    stride: int = 1
    """Use every n-th frame: 3 makes the motion three times as fast."""
    solvers: str = "gn"
    """Which solvers, joined by commas: gn, adam (the paper's, slow)."""
    ablation: bool = False
    """Print the ablation table instead of comparing solvers."""
    seeds: str = "0"
    """Seeds, joined by commas; the table shows the band over them."""
    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = field(default_factory=SlamConfig)
    """Settings that all variants share."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its table."""
    config = parse(TrackBenchmark, arguments, prog="magic bench track", description=__doc__ or "")
    from magic_agent.tracking import benchmark

    shared = {
        "scale": config.scale,
        "frames": config.frames,
        "stride": config.stride,
        "config": config.slam,
        "seeds": _seeds(config.seeds),
        "progress": lambda text: console.print(text, markup=False),
    }
    if config.ablation:
        result = benchmark.run_ablation(config.dataset, **shared)
        console.print(_table(result["variants"]))
    else:
        solvers = [name.strip() for name in config.solvers.split(",")]
        if unknown := set(solvers) - set(benchmark.SOLVERS):
            raise ConfigError(f"--solvers {', '.join(sorted(unknown))}: expected gn or adam")
        result = benchmark.run(config.dataset, solvers=solvers, **shared)
        console.print(_table(result["solvers"]))
        if result["speedup"]:
            console.print(f"gn is {result['speedup']:.1f} times as fast as adam")
    if config.json:
        print_json(result)
    return 0


def _seeds(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"--seeds {text}: expected whole numbers, as in 0,1,2") from error


def _table(variants: dict):
    rows = []
    for name, found in variants.items():
        low, high = found["mean_ate_band_m"]
        agents = " / ".join(f"{100 * value:.2f}" for value in found["ate_rmse_m"].values())
        times = found["ms_per_frame"]
        rows.append(
            [
                name,
                f"{100 * found['mean_ate_m']:.2f} ({100 * low:.2f}-{100 * high:.2f})",
                agents,
                str(found["lost_frames"]),
                f"{times['median']:.1f} / {times['p95']:.1f}",
                f"{found['mapping_ms_per_frame']:.1f}",
            ]
        )
    columns = [
        "variant",
        "mean ATE cm (band)",
        "agents cm",
        "lost",
        "ms (median/p95)",
        "mapping ms",
    ]
    return table("Tracking without loop closure", columns, rows)
