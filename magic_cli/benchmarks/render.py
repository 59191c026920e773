"""`magic bench render`: forward and backward of the rasteriser, and what stands beside it.

`--against` times the prototype in the same process, in turns. Further figures: a whole mapping
iteration, the 8-lane path, the torch reference, and the share of the processor's peak. With
`--device`, whole frames of 1200 x 680 are timed on that device instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magic_cli.options import parse
from magic_cli.output import console, print_json, table


@dataclass(frozen=True, slots=True)
class RenderBenchmark:
    """Options of `magic bench render`."""

    against: Path | None = None
    """Folder of a prototype (ngs.py) to time in the same run."""
    repeats: int = 15
    """Runs of each cell, in turns; medians are printed."""
    extras: bool = True
    """Measure the four further figures too."""
    device: Literal["cpu", "cuda"] | None = None
    """Time forward + backward and a mapping iteration of whole frames on this device."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its table."""
    config = parse(RenderBenchmark, arguments, prog="magic bench render", description=__doc__ or "")
    if config.device is not None:
        return _on_device(config.device, config)
    from magic_core.render.benchmark import run

    with console.status("timing") as status:
        result = run(
            config.against, repeats=config.repeats, extras=config.extras, progress=status.update
        )
    rows = [
        [
            f"{cell['size']}, {cell['gaussians']:,}",
            str(cell["threads"]),
            _number(cell["forward_ms"]),
            _number(cell["forward_backward_ms"]),
            _number(cell["against_forward_backward_ms"]),
            _number(cell["ratio"]),
        ]
        for cell in result["cells"]
    ]
    columns = ["image, Gaussians", "threads", "forward ms", "+ backward ms", "against ms", "ratio"]
    console.print(table("Rasteriser, medians", columns, rows))
    others = [[name, _number(value)] for name, value in result.items() if name != "cells"]
    console.print(table("Beside it", ["figure", "value"], others))
    if config.json:
        print_json(result)
    return 0


def _on_device(device: Literal["cpu", "cuda"], config: RenderBenchmark) -> int:
    from magic_core.render.device_benchmark import run

    with console.status("timing") as status:
        result = run(device, repeats=config.repeats, progress=status.update)
    rows = [
        [
            f"{cell['size']}, {cell['gaussians']:,}",
            _number(cell["forward_backward_ms"]),
            _number(cell["iteration_ms"]),
        ]
        for cell in result["cells"]
    ]
    columns = ["image, Gaussians", "forward + backward ms", "mapping iteration ms"]
    console.print(table(f"On {result['device']}, medians", columns, rows))
    if config.json:
        print_json(result)
    return 0


def _number(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if isinstance(value, (int, float)) else str(value)
