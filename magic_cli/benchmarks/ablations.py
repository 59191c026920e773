"""`magic bench ablations DATASET`: the paper's ablation tables with our rows.

Runs the dataset once per variant and seed and prints mean and band over the seeds: loop closure
off, pose initialisation off, other image encoders, other ways to register loops (the paper's FPFH
on anchor clouds, and Gaussian means instead), all Gaussians sent instead of those that the next
sub-map cannot see, and the map before and after its fine merging.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError, MagicError

FULL = "full system"


@dataclass(frozen=True, slots=True)
class AblationsBenchmark:
    """Options of `magic bench ablations`."""

    dataset: Positional[str]
    """Folder of a dataset, or synthetic://flat?agents=3&frames=120."""
    seeds: str = "0,1,2"
    """Seeds, separated by commas; each variant runs once per seed."""
    scale: float = 0.5
    """Process images at this fraction of their size."""
    frames: int | None = None
    """Use only so many frames of each agent."""
    merge_passes: int = 8
    """Passes of the fine merging; fewer than a run's own, since there are many runs."""
    models: tuple[str, ...] = ()
    """Further image encoders: names, or paths of ONNX files."""
    only: tuple[str, ...] = ()
    """Only these variants, by their names in the tables, beside the full system."""
    keep: Path | None = None
    """Keep the run folders here; what is there already is not run again."""
    json: bool = False
    """Print one JSON object as the last line."""

    def seed_list(self) -> list[int]:
        """The seeds; ConfigError names what is no number."""
        try:
            seeds = [int(part) for part in self.seeds.split(",")]
        except ValueError as error:
            raise ConfigError.field(
                "seeds", f"{self.seeds!r}: expected whole numbers separated by commas"
            ) from error
        return seeds


@dataclass(frozen=True, slots=True)
class Variant:
    """A system with one part changed."""

    name: str
    options: tuple[str, ...]
    """What `magic run` is given beside the dataset."""


def variants(models: Sequence[str] = ()) -> list[Variant]:
    """The full system first."""
    return [
        Variant(FULL, ()),
        Variant("without loop closure", ("--loops", "off")),
        Variant("without pose initialisation",
                ("--tracking.initialisation", "constant_velocity",
                 "--tracking.no-rotation-prealignment")),
        Variant("loops by FPFH on anchor clouds", ("--registration.methods", "fpfh")),
        Variant("loops by Gaussian means", ("--registration.methods", "means")),
        Variant("all Gaussians sent", ("--submap.send-all",)),
        *(Variant(f"encoder {Path(model).stem}", ("--places-model", model)) for model in models),
    ]  # fmt: skip


def main(arguments: list[str]) -> int:
    """Run the variants and print the tables."""
    config = parse(
        AblationsBenchmark, arguments, prog="magic bench ablations", description=__doc__ or ""
    )
    seeds, chosen = config.seed_list(), _chosen(config)
    results: dict[str, dict[int, dict[str, Any]]] = {}
    failed: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="magic-ablations-") as scratch:
        root = config.keep or Path(scratch)
        for variant in chosen:
            try:
                results[variant.name] = {seed: _run(variant, seed, config, root) for seed in seeds}
            except MagicError as error:
                failed[variant.name] = error.message
                console.print(f"{variant.name}: {error.message}")
    if FULL not in results:
        raise MagicError(f"the full system did not run: {failed[FULL]}")
    for rows in tables(results):
        console.print(rows)
    if config.json:
        print_json({"seeds": seeds, "variants": results, "failed": failed})
    return 0


def _chosen(config: AblationsBenchmark) -> list[Variant]:
    known = variants(config.models)
    unknown = [name for name in config.only if name not in {v.name for v in known}]
    if unknown:
        names = "; ".join(variant.name for variant in known)
        raise ConfigError.field("only", f"{unknown[0]!r}: expected some of: {names}")
    return [v for v in known if not config.only or v.name in (FULL, *config.only)]


def _run(variant: Variant, seed: int, config: AblationsBenchmark, root: Path) -> dict[str, Any]:
    """The metrics of one run, in a process of its own."""
    out = root / variant.name.replace(" ", "_") / f"seed_{seed}"
    if (out / "metrics.json").is_file():
        return json.loads((out / "metrics.json").read_text())
    command = [sys.executable, "-m", "magic_cli", "run", config.dataset, "--out", str(out),
               "--seed", str(seed), "--merge.seed", str(seed), "--scale", str(config.scale),
               "--merge.passes", str(config.merge_passes), "--no-report", "--json",
               *variant.options]  # fmt: skip
    if config.frames is not None:
        command += ["--frames", str(config.frames)]
    with console.status(f"{variant.name}, seed {seed}"):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = done.stderr.strip().splitlines()
        raise MagicError(said[-1] if said else f"magic run ended with code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


Value = Callable[[dict[str, Any]], float | None]


def tables(results: dict[str, dict[int, dict[str, Any]]]):
    """The paper's tables: tracking, loop constraints, rendering, size and time."""
    agents = sorted({
        name for runs in results.values() for m in runs.values() for name in m["ate_rmse_m"]
        if name != "joint"
    })  # fmt: skip
    tracking: list[tuple[str, Value]] = [
        (name, lambda m, name=name: _scaled(m["ate_rmse_m"].get(name), 100)) for name in agents
    ]
    tracking += [
        ("average", lambda m: _average(m["ate_rmse_m"].get(name) for name in agents)),
        ("all agents jointly", lambda m: _scaled(m["ate_rmse_m"].get("joint"), 100)),
        ("odometry alone", lambda m: _average(m["ate_tracked_rmse_m"].get(n) for n in agents)),
    ]
    yield _table("Tracking, ATE RMSE in cm", results, tracking)
    loops: list[tuple[str, Value]] = [
        ("candidates", lambda m: m["loops"]["detected"]),
        ("accepted", lambda m: m["loops"]["accepted"]),
        ("components", lambda m: m.get("components")),
    ]
    yield _table("Loops", results, loops, digits=1)
    rendering: list[tuple[str, Value]] = [
        (f"{label} {kind}", lambda m, name=name, kind=kind, factor=factor:
            _scaled((m.get(name) or {}).get(kind), factor))
        for label, name, factor in (("PSNR", "psnr_db", 1), ("SSIM", "ssim", 1),
                                    ("LPIPS", "lpips", 1), ("depth cm", "depth_l1_m", 100))
        for kind in ("train", "novel")
    ]  # fmt: skip
    yield _table("Rendering of the merged map", results, rendering)
    merging: list[tuple[str, Value]] = [
        (f"{kind} {stage}", lambda m, key=f"{kind}{suffix}": (m.get("psnr_db") or {}).get(key))
        for kind in ("train", "novel")
        for stage, suffix in (("appended", "_coarse"), ("refined", ""))
    ]
    yield _table("Map merging, PSNR in dB", results, merging)
    size: list[tuple[str, Value]] = [
        ("MB per sub-map", lambda m: _scaled(m["wire_bytes_per_submap"]["compact"], 1e-6)),
        ("lossless", lambda m: _scaled(m["wire_bytes_per_submap"]["lossless"], 1e-6)),
        ("agent's peak MB", lambda m: _scaled(m["peak_rss_bytes"], 1e-6)),
        ("tracking ms", lambda m: m["tracking_ms"]["median"]),
        ("merge s", lambda m: m["merge_s"]),
    ]
    yield _table("Size and time", results, size)


def _table(
    title: str,
    results: dict[str, dict[int, dict[str, Any]]],
    columns: list[tuple[str, Value]],
    *,
    digits: int = 2,
):
    rows = [
        [name, *(_band([value(m) for m in runs.values()], digits) for _, value in columns)]
        for name, runs in results.items()
    ]
    return table(title, ["", *(label for label, _ in columns)], rows)


def _band(values: Sequence[float | None], digits: int) -> str:
    """Mean, and lowest to highest where there are several."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    mean = f"{np.mean(known):.{digits}f}"
    if len(known) == 1:
        return mean
    return f"{mean} ({min(known):.{digits}f} to {max(known):.{digits}f})"


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _average(metres: Any) -> float | None:
    known = [value for value in metres if value is not None]
    return 100 * float(np.mean(known)) if known else None
