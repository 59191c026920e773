"""`magic bench loops DATASET...`: are the right loops found, and only those?

Takes every n-th frame of each agent as an anchor, registers every pair with each method, and
compares with the overlap that the true poses give. Several datasets at once also test every pair
across them, which must all be refused.

With --described, instead: which loops are found by descriptors of anchors alone and which by those
of keyframes too (--places-keyframes of an agent), and what the candidates come to.

Example: magic bench loops ../shared/data/redkitchen ../shared/data/living_room_3agents --every 50
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table

if TYPE_CHECKING:
    from magic_server.registration import AnchorView


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
    described: tuple[int, ...] = ()
    """Compare these numbers of described keyframes per sub-map, at the encoder's own threshold and
    with the first of `methods`; 0 is anchors alone."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its tables."""
    config = parse(LoopsBenchmark, arguments, prog="magic bench loops", description=__doc__ or "")
    return _compare_described(config) if config.described else _register_all(config)


def _register_all(config: LoopsBenchmark) -> int:
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


def _compare_described(config: LoopsBenchmark) -> int:
    from magic_agent.places import load_descriptor_model
    from magic_server.loops import LoopConfig
    from magic_server.registration.config import RegistrationConfig
    from magic_server.registration.described_benchmark import run

    found = {}
    methods = tuple(config.methods[0].split("+"))
    with console.status("registering pairs") as status:
        for name in config.models:
            model = load_descriptor_model(name)
            found[name] = run(
                config.datasets,
                describe=model.describe,
                choose=_chosen,
                counts=config.described,
                min_similarity=LoopConfig().threshold(model.model_id),
                every=config.every,
                scale=config.scale,
                keyframes=config.keyframes,
                config=RegistrationConfig(methods=methods),  # type: ignore[arg-type]
                progress=lambda share, text: status.update(f"{text}: {share:.0%} of the pairs"),
            )
    for name, result in found.items():
        console.print(_described(name, result))
        choose_ms = max(row["choose_ms"] for row in result["described"])
        console.print(
            f"encoder {result['describe_ms']:.1f} ms of processor per image, choosing at most "
            f"{choose_ms:.1f} ms per sub-map"
        )
    if config.json:
        print_json(found)
    return 0


def _chosen(view: AnchorView, count: int) -> list[int]:
    """The keyframes that an agent would describe."""
    from magic_agent.places.keyframes import spread_keyframes
    from magic_core.submap import Keyframe

    images = [(np.eye(4), view.colour, view.depth), *view.keyframes]
    keyframes = [Keyframe(place, float(place), *image) for place, image in enumerate(images)]
    return spread_keyframes(keyframes, view.camera, count)


def _described(name: str, result: dict):
    bins = list(result["described"][0]["by_overlap"])
    columns = ["described", "per sub-map", "candidates", *(f"found, right of {b}" for b in bins),
               "accepted", "wrong", "time"]  # fmt: skip
    rows = []
    for row in result["described"]:
        shares = [row["by_overlap"][b] for b in bins]
        rows.append([
            str(row["described"]), f"{row['descriptors_per_submap']:.2f}", str(row["candidates"]),
            *(f"{s['detected']} / {s['right']} of {s['pairs']}" for s in shares),
            str(row["accepted"]), str(row["wrong"]), f"{row['seconds']:.0f} s",
        ])  # fmt: skip
    title = (
        f"{name} from {result['min_similarity']:.3f}: {result['submaps']} sub-maps, "
        f"{result['pairs']} pairs, {result['loops']} overlapping"
    )
    return table(title, columns, rows)


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
