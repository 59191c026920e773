"""`magic bench NAME`: benchmarks; each prints medians and ratios, `--json` one JSON object.

magic bench render [--against PROTOTYPE]   forward and backward of the rasteriser
magic bench track DATASET                  accuracy and speed of tracking, solver by solver
magic bench map DATASET                    rendering of sub-maps, our schedule against the paper's
magic bench agent DATASET --threads N      frames per second of one whole agent
magic bench loops DATASET...               precision and recall of loop detection and verification
magic bench merge RUN|DATASET              fine merging against the paper's scheme, and its memory
magic bench codec DATASET|RUN              bytes per sub-map, and what the compact codec costs
magic bench ablations DATASET              the paper's tables with our rows, each part left out
magic bench server                         many agents at once: rate, latencies, memory, event loop
magic bench viewer                         what watching a large map costs: processor time and bytes
"""

from __future__ import annotations

import importlib
import sys

BENCHMARKS = {
    "render": "magic_cli.benchmarks.render",
    "track": "magic_cli.benchmarks.track",
    "map": "magic_cli.benchmarks.map",
    "agent": "magic_cli.benchmarks.agent",
    "loops": "magic_cli.benchmarks.loops",
    "merge": "magic_cli.benchmarks.merge",
    "codec": "magic_cli.benchmarks.codec",
    "ablations": "magic_cli.benchmarks.ablations",
    "server": "magic_cli.benchmarks.server",
    "viewer": "magic_cli.benchmarks.viewer",
}


def main(arguments: list[str]) -> int:
    """Run one benchmark by name."""
    if arguments[:1] in (["-h"], ["--help"]):
        print(f"usage: magic bench {{{','.join(BENCHMARKS)}}} [options]\n\n{__doc__}")
        return 0
    if not arguments or arguments[0] not in BENCHMARKS:
        names = ", ".join(BENCHMARKS)
        print(f"magic bench: expected one of {names}", file=sys.stderr)
        return 2
    return importlib.import_module(BENCHMARKS[arguments[0]]).main(arguments[1:])
