"""`magic export RUN --what map|trajectories|posegraph`: a run's results in other formats.

Examples:
  magic export runs/demo --what trajectories --format kitti --out kitti/
  magic export runs/demo --what map --out scene.ply
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json
from magic_core.errors import ConfigError, NotFound
from magic_core.evaluation import RunFolder, write_kitti, write_tum


@dataclass(frozen=True, slots=True)
class ExportConfig:
    """Options of `magic export`."""

    run: Positional[Path]
    """Run folder."""
    out: Path
    """File (map, pose graph) or folder (trajectories) to write."""
    what: Literal["map", "trajectories", "posegraph"] = "map"
    """What to write."""
    format: Literal["ply", "tum", "kitti", "g2o"] | None = None
    """map: ply (standard 3DGS). trajectories: tum (default) or kitti. posegraph: g2o."""
    kind: Literal["tracked", "corrected", "ground_truth"] = "corrected"
    """Which trajectories: odometry alone, after the pose graph, or the data's own."""
    json: bool = False
    """Print one JSON object as the last line."""


FORMATS = {"map": ("ply",), "trajectories": ("tum", "kitti"), "posegraph": ("g2o",)}


def main(arguments: list[str]) -> int:
    """Write the chosen files and list them."""
    config = parse(ExportConfig, arguments, prog="magic export", description=__doc__ or "")
    chosen = config.format or FORMATS[config.what][0]
    if chosen not in FORMATS[config.what]:
        choices = ", ".join(FORMATS[config.what])
        raise ConfigError(f"--format {chosen}: {config.what} can be written as {choices}")
    folder = RunFolder(config.run)
    if config.what == "trajectories":
        written = _trajectories(folder, config, chosen)
    else:
        source = folder.map_path if config.what == "map" else folder.posegraph_path
        written = [_copy(source, config.out)]
    for path in written:
        console.print(f"Written: {path}", soft_wrap=True)
    if config.json:
        print_json({"written": [str(path) for path in written]})
    return 0


def _trajectories(folder: RunFolder, config: ExportConfig, chosen: str) -> list[Path]:
    written = []
    for agent in folder.agents():
        if folder.has_trajectory(agent, config.kind):
            config.out.mkdir(parents=True, exist_ok=True)
            path = config.out / f"{agent}.txt"
            write = write_kitti if chosen == "kitti" else write_tum
            write(path, folder.read_trajectory(agent, config.kind))
            written.append(path)
    if not written:
        raise NotFound(f"{folder.path}: no {config.kind} trajectory; is this a finished run?")
    return written


def _copy(source: Path, target: Path) -> Path:
    if not source.is_file():
        raise NotFound(f"{source}: not in this run folder; did the run finish?")
    target.parent.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copyfile(source, target))
