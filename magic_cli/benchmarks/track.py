"""`magic bench track DATASET`: accuracy and speed of tracking, without loop closure.

Runs the whole local SLAM of every agent once per solver, side by side on the same frames.
`--ablations` compares each pose initialisation, pyramid depth and part of the tracker instead, as
the paper's table. With several seeds every figure comes with its band: least, median, largest.
`--faults` plays black frames, missing depth, exposure jumps and a kidnapped camera instead, and
fails (exit status 1) where a pose is claimed that is not true.

Examples:
  magic bench track DATASET --scale 0.5 --solvers gn,adam --frames 60
  magic bench track DATASET --solvers gn --seeds 0,1,2
  magic bench track DATASET --stride 3
  magic bench track DATASET --ablations --frames 100
  magic bench track DATASET --faults
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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
    ablations: bool = False
    """Print the ablation table instead of comparing solvers."""
    faults: bool = False
    """Play camera faults into the recording instead, with the default solver and the first seed."""
    seeds: str = "0"
    """Seeds, joined by commas; the table shows the band over them."""
    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = field(default_factory=SlamConfig)
    """Settings that all variants share."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its table."""
    config = parse(TrackBenchmark, arguments, prog="magic bench track", description=__doc__ or "")
    if config.faults:
        return _faults(config)
    from magic_agent.tracking import benchmark

    shared = {
        "scale": config.scale,
        "frames": config.frames,
        "stride": config.stride,
        "config": config.slam,
        "seeds": _seeds(config.seeds),
        "progress": lambda text: console.print(text, markup=False),
    }
    if config.ablations:
        result = benchmark.run_ablations(config.dataset, **shared)
        _show(result["variants"])
    else:
        solvers = [name.strip() for name in config.solvers.split(",")]
        if unknown := set(solvers) - set(benchmark.SOLVERS):
            raise ConfigError(f"--solvers {', '.join(sorted(unknown))}: expected gn or adam")
        result = benchmark.run(config.dataset, solvers=solvers, **shared)
        _show(result["solvers"])
        if result["speedup"]:
            console.print(f"gn is {result['speedup']:.1f} times as fast as adam")
    if config.json:
        print_json(result)
    return 0


def _faults(config: TrackBenchmark) -> int:
    from magic_agent.tracking.faults import run_faults

    result = run_faults(
        config.dataset,
        scale=config.scale,
        config=replace(config.slam, seed=_seeds(config.seeds)[0]),
        progress=lambda text: console.print(text, markup=False),
    )
    rows = [
        [agent, name, found["outcome"], str(found["lost_frames"]), str(found["breaks"])]
        + [f"{100 * found[figure]:.2f}" for figure in ("ate_rmse_m", "worst_m")]
        for agent, reports in result["faults"].items()
        for name, found in reports.items()
    ]
    columns = ["agent", "fault", "outcome", "lost", "breaks", "ATE cm", "worst cm"]
    console.print(table("Camera faults", columns, rows))
    if config.json:
        print_json(result)
    return 1 if result["wrong"] else 0


def _seeds(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"--seeds {text}: expected whole numbers, as in 0,1,2") from error


def _show(variants: dict) -> None:
    console.print(_table(variants))
    console.print(_stages_table(variants))


def _table(variants: dict):
    rows = [_row(name, found) for name, found in variants.items()]
    columns = [
        "variant",
        "mean ATE cm (band)",
        "agents cm",
        "lost",
        "breaks",
        "ms (median/p95)",
        "mapping ms",
    ]
    return table("Tracking without loop closure", columns, rows)


def _row(name: str, found: dict) -> list[str]:
    low, middle, high = (100 * value for value in found["bands"]["mean_ate_m"])
    band = f" ({low:.2f}-{high:.2f})" if low != high else ""
    times = found["ms_per_frame"]
    return [
        name,
        f"{middle:.2f}{band}",
        " / ".join(f"{100 * value:.2f}" for value in found["ate_rmse_m"].values()),
        str(found["lost_frames"]),
        str(found["breaks"]),
        f"{times['median']:.1f} / {times['p95']:.1f}",
        f"{found['mapping_ms_per_frame']:.1f}",
    ]


def _stages_table(variants: dict):
    stages = list(
        dict.fromkeys(stage for found in variants.values() for stage in found["stages_ms"])
    )
    rows = [
        [name, *(f"{found['stages_ms'].get(stage, 0.0):.1f}" for stage in stages)]
        for name, found in variants.items()
    ]
    return table("Median time per frame by stage, ms", ["variant", *stages], rows)
