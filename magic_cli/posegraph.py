"""`magic posegraph solve FILE...`: solve pose graphs in g2o files with the server's own solver.

Several files are read as one graph, one robot each.

Examples:
  magic posegraph solve runs/office/posegraph.g2o
  magic posegraph solve robot_0.g2o robot_1.g2o --robust gnc --out solved.g2o
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table


@dataclass(frozen=True, slots=True)
class SolveConfig:
    """Options of `magic posegraph solve`."""

    files: Positional[tuple[Path, ...]]
    """g2o files: one graph, or one file per robot of the same graph."""
    robust: Literal["none", "gnc"] = "gnc"
    """`gnc` finds and leaves out wrong loops; `none` trusts every edge."""
    out: Path | None = None
    """Write the solved graph here, as g2o."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Solve and print error before and after, time, and which loops were kept."""
    if arguments[:1] != ["solve"]:
        asked = arguments[:1] in (["-h"], ["--help"])
        usage = f"usage: magic posegraph solve FILE... [options]\n\n{__doc__}"
        print(usage, file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    config = parse(
        SolveConfig, arguments[1:], prog="magic posegraph solve", description=__doc__ or ""
    )
    from magic_server.posegraph.solve_files import solve_files

    with console.status("solving"):
        result = solve_files(config.files, robust=config.robust, output=config.out)
    rows = [
        ["vertices / edges", f"{result['vertices']:,} / {result['edges']:,}"],
        ["components", str(result["components"])],
        ["error before", f"{result['error_before']:.6g}"],
        ["error after", f"{result['error_after']:.6g}"],
        ["loops kept / rejected", f"{result['loops_kept']:,} / {len(result['loops_rejected']):,}"],
        ["time", f"{result['seconds']:.2f} s"],
    ]
    console.print(table("Half the squared Mahalanobis norm of the residuals", ["", ""], rows))
    if config.out is not None:
        console.print(f"Written: {config.out}")
    if config.json:
        print_json(result)
    return 0
