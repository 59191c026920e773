"""Run the loop benchmark on recordings and write its report as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from magic_agent.places import load_descriptor_model
from magic_server.registration.benchmark import run


def main() -> None:
    """Parse, run, print the summary; every pair goes into the file of --output."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=50, help="anchor every n frames")
    parser.add_argument("--scale", type=float, default=0.5, help="image scale")
    parser.add_argument(
        "--methods", nargs="+", default=["visual+kiss", "visual", "kiss", "fpfh", "means"],
        help="coarse methods; + tries several for each pair",
    )  # fmt: skip
    parser.add_argument("--models", nargs="*", default=["efficientnet_lite0"])
    parser.add_argument("--output", type=Path, help="file for the whole report")
    options = parser.parse_args()
    report = run(
        options.datasets,
        methods=[tuple(methods.split("+")) for methods in options.methods],
        describers={name: load_descriptor_model(name).describe for name in options.models},
        every=options.every,
        scale=options.scale,
        progress=lambda share, text: print(f"\r{text} {share:4.0%}", end="", file=sys.stderr),
    )
    if options.output:
        options.output.write_text(json.dumps(report))
    del report["pairs"]
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
