"""`magic bench render`: forward and backward of the rasteriser, in milliseconds and as ratios.

Examples:
  magic bench render
  magic bench render --against PROTOTYPE_FOLDER --json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from magic_cli.options import parse
from magic_cli.output import console, print_json, table


@dataclass(frozen=True, slots=True)
class RenderBenchmark:
    """Options of `magic bench render`."""

    against: Path | None = None
    """Folder of the prototype (ngs.py) to time in the same run."""
    repeats: int = 15
    """Interleaved runs per cell; medians are reported."""
    quick: bool = False
    """Only the smallest cell, and none of the extra figures."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its table."""
    config = parse(RenderBenchmark, arguments, prog="magic bench render", description=__doc__ or "")
    from magic_core.render import benchmark

    cells = benchmark.CELLS[:1] if config.quick else benchmark.CELLS
    result = benchmark.run(
        config.against,
        repeats=config.repeats,
        cells=cells,
        extras=not config.quick,
        progress=lambda text: console.print(text, markup=False),
    )
    console.print(_table(result["cells"]))
    if config.json:
        print_json(result)
    return 0


def _table(cells: list[dict]):
    rows = [
        [
            f"{cell['size']} {cell['gaussians'] // 1000}k", str(cell["threads"]),
            f"{cell['forward_ms']:.2f}", f"{cell['forward_backward_ms']:.2f}",
            "" if cell["ratio"] is None else f"{cell['against_forward_backward_ms']:.2f}",
            "" if cell["ratio"] is None else f"{cell['ratio']:.3f}",
        ]
        for cell in cells
    ]  # fmt: skip
    columns = ["cell", "threads", "forward ms", "forward+backward ms", "against ms", "ratio"]
    return table("rasteriser", columns, rows)
