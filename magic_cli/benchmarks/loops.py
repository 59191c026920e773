"""`magic bench loops DATASET...`: are the right loops found, and only those?

Takes every n-th frame of each agent as an anchor, registers every pair with each method, and
compares with the overlap that the true poses give. Several datasets at once also test every pair
across them, which must all be refused.

Example: magic bench loops ../shared/data/redkitchen ../shared/data/living_room_3agents --every 50
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table


@dataclass(frozen=True, slots=True)
class LoopsBenchmark:
    """Options of `magic bench loops`."""

    datasets: Positional[tuple[Path, ...]]
    """Datasets with ground truth."""
    every: int = 30
    """Every n-th frame of an agent is an anchor."""
    scale: float = 0.5
    """Process images at this fraction of their size."""
    keyframes: int = 4
    """So many later frames, 10 apart, come with each anchor, as a sub-map's keyframes do; 0: the
    anchors alone."""
    methods: tuple[str, ...] = ("visual", "visual+kiss", "kiss", "fpfh", "means")
    """Coarse registration methods, `+` joins those that are tried together."""
    models: tuple[str, ...] = ("efficientnet_lite0",)
    """Image encoders: names, or paths of ONNX files."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its tables."""
    config = parse(LoopsBenchmark, arguments, prog="magic bench loops", description=__doc__ or "")
    from magic_agent.places import load_descriptor_model
    from magic_server.registration.benchmark import run

    with console.status("registering pairs") as status:
        result = run(
            config.datasets,
            methods=[tuple(label.split("+")) for label in config.methods],
            describers={name: load_descriptor_model(name).describe for name in config.models},
            every=config.every,
            scale=config.scale,
            keyframes=config.keyframes,
            progress=lambda share, text: status.update(f"{text}: {share:.0%} of the pairs"),
        )
    console.print(_verification(result))
    console.print(_detection(result))
    if config.json:
        print_json(result)
    return 0


def _verification(result: dict):
    bins = next(iter(result["verification"].values()))["recall_by_overlap"]
    columns = ["method", "precision", *(f"recall {b}" for b in bins), "error", "median / p95 time"]
    rows = []
    for method, found in result["verification"].items():
        recall = [_share(found["recall_by_overlap"][b]["recall"]) for b in bins]
        error = found["median_error_m"]
        centimetres = "-" if error is None else f"{100 * error:.2f} cm"
        times = f"{found['median_seconds']:.3f} / {found['p95_seconds']:.2f} s"
        rows.append([method, _share(found["precision"]), *recall, centimetres, times])
    title = f"Verification: {result['anchors']} anchors, {len(result['pairs'])} registrations"
    return table(title, columns, rows)


def _detection(result: dict):
    rows = [
        [name, f"{point['threshold']:.2f}", _share(point["precision"]), _share(point["recall"]),
         str(point["candidates"])]
        for name, found in result["detection"].items()
        for point in found["curve"]
    ]  # fmt: skip
    for name, found in result["detection"].items():
        if best := found["calibrated"]:
            rows.append([f"{name}, calibrated", f"{best['threshold']:.3f}",
                         _share(best["precision"]), _share(best["recall"]),
                         str(best["candidates"])])  # fmt: skip
    columns = ["encoder", "similarity from", "precision", "recall", "candidates"]
    return table("Detection by descriptor", columns, rows)


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"
