"""`magic bench map DATASET`: how well sub-maps render, our mapping schedule against the paper's.

Both map the same frames at the same poses; every fifth frame is withheld and shows how new views
look. Each schedule runs with its own budget, and with as many steps and as much time as the other
took. Time is CPU time of one thread.

Examples:
  magic bench map DATASET --frames 90 --seeds 0
  magic bench map DATASET --poses truth --json
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from magic_agent.slam_config import SlamConfig
from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class MapBenchmark:
    """Options of `magic bench map`."""

    dataset: Positional[str]
    """Dataset: one recording, or one per agent."""
    scale: float = 0.5
    """Process images at this fraction of their size."""
    frames: int | None = None
    """Use only so many frames of each agent."""
    poses: Literal["truth", "tracked"] = "tracked"
    """Map at the poses that tracking finds, once for all variants, or at the ground truth's."""
    seeds: str = "0,1,2"
    """Seeds, joined by commas; the table shows the band over them."""
    slam: Annotated[SlamConfig, tyro.conf.arg(name="")] = field(default_factory=SlamConfig)
    """Settings that both schedules share; the paper's values replace those that it gives."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its tables."""
    config = parse(MapBenchmark, arguments, prog="magic bench map", description=__doc__ or "")
    from magic_agent.mapping import benchmark

    result = benchmark.run(
        config.dataset,
        scale=config.scale,
        frames=config.frames,
        poses=config.poses,
        config=config.slam,
        seeds=_seeds(config.seeds),
        progress=lambda text: console.print(text, markup=False),
    )
    console.print(_variants(result["variants"]))
    console.print(_gains(result["gains"]))
    if config.json:
        print_json(result)
    return 0


def _seeds(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"--seeds {text}: expected whole numbers, as in 0,1,2") from error


def _variants(variants: dict):
    rows = []
    for name, found in variants.items():
        psnr, ssim, depth = (found[metric] for metric in ("psnr_db", "ssim", "depth_l1_m"))
        rows.append(
            [
                name,
                *(_band(psnr[kind]) for kind in ("keyframes", "new_views")),
                *(f"{ssim[kind]['mean']:.3f}" for kind in ("keyframes", "new_views")),
                *(f"{100 * depth[kind]['mean']:.2f}" for kind in ("keyframes", "new_views")),
                f"{found['iterations_per_frame']:.1f}",
                f"{found['cpu_ms_per_frame']:.0f}",
                f"{found['gaussians_per_submap']:,.0f}",
            ]
        )
    columns = [
        "schedule / budget", "PSNR dB keyframes", "new views", "SSIM", "new",
        "depth cm", "new", "steps/frame", "CPU ms/frame", "Gaussians",
    ]  # fmt: skip
    return table("Rendering of sub-maps", columns, rows)


def _gains(gains: dict):
    rows = [
        [budget, *(_band(gain["psnr_db"][kind]) for kind in ("keyframes", "new_views"))]
        for budget, gain in gains.items()
    ]
    columns = ["budget", "PSNR dB keyframes", "new views"]
    return table("Ours minus the paper's at equal budget", columns, rows)


def _band(band: dict) -> str:
    return f"{band['mean']:.2f} ({band['low']:.2f} to {band['high']:.2f})"
