"""The folder that one run leaves behind: every path in it, and typed reading and writing.

    config.yaml  metrics.json  report.html  overview.png  map.ply  map_coarse.ply  posegraph.g2o
    loops.json  components.json
    trajectories/{agent}_{tracked,corrected,ground_truth}.txt    TUM format
    agents/{agent}/report.json
    server/                                                      the server's own store

Files are replaced in one step, so that a reader never sees half of one. Reading what was never
written raises NotFound; the `has_*` checks and `agents()` say what there is.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from magic_core.errors import CorruptData, NotFound
from magic_core.evaluation import records
from magic_core.evaluation.trajectory import Trajectory, read_tum, write_tum
from magic_core.gaussians import GaussianCloud

TrajectoryKind = Literal["tracked", "corrected", "ground_truth"]
TRAJECTORY_KINDS: tuple[TrajectoryKind, ...] = get_args(TrajectoryKind)


class RunFolder:
    """One run's results on disk; folders are made when something is written into them."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.config_path = self.path / "config.yaml"
        self.metrics_path = self.path / "metrics.json"
        self.report_path = self.path / "report.html"
        self.overview_path = self.path / "overview.png"
        self.map_path = self.path / "map.ply"
        self.coarse_map_path = self.path / "map_coarse.ply"
        self.posegraph_path = self.path / "posegraph.g2o"
        self.loops_path = self.path / "loops.json"
        self.components_path = self.path / "components.json"
        self.trajectories_folder = self.path / "trajectories"
        self.agents_folder = self.path / "agents"
        self.server_folder = self.path / "server"

    def create(self) -> RunFolder:
        """Make the folder and its sub-folders."""
        for folder in (self.trajectories_folder, self.agents_folder, self.server_folder):
            folder.mkdir(parents=True, exist_ok=True)
        return self

    def agents(self) -> list[str]:
        """Names of the agents that left a report or a trajectory, sorted."""
        names = {path.parent.name for path in self.agents_folder.glob("*/report.json")}
        for kind in TRAJECTORY_KINDS:
            suffix = f"_{kind}.txt"
            names |= {
                path.name.removesuffix(suffix)
                for path in self.trajectories_folder.glob(f"*{suffix}")
            }
        return sorted(names)

    def trajectory_path(self, agent: str, kind: TrajectoryKind) -> Path:
        """Where one trajectory of an agent lies."""
        return self.trajectories_folder / f"{agent}_{kind}.txt"

    def agent_report_path(self, agent: str) -> Path:
        """Where an agent's own report lies."""
        return self.agents_folder / agent / "report.json"

    def write_trajectory(self, agent: str, kind: TrajectoryKind, trajectory: Trajectory) -> None:
        """Write `trajectories/{agent}_{kind}.txt`."""
        path = self.trajectory_path(agent, kind)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = _partial(path)
        write_tum(partial, trajectory)
        partial.replace(path)

    def read_trajectory(self, agent: str, kind: TrajectoryKind) -> Trajectory:
        """Read `trajectories/{agent}_{kind}.txt`."""
        return read_tum(self._existing(self.trajectory_path(agent, kind)))

    def has_trajectory(self, agent: str, kind: TrajectoryKind) -> bool:
        """Whether this trajectory was written."""
        return self.trajectory_path(agent, kind).is_file()

    def write_agent_report(self, report: records.AgentReport) -> None:
        """Write `agents/{agent}/report.json`."""
        _write_json(self.agent_report_path(report.agent), records.to_json(report))

    def read_agent_report(self, agent: str) -> records.AgentReport:
        """Read `agents/{agent}/report.json`."""
        return records.agent_report_from_json(self._read_json(self.agent_report_path(agent)))

    def write_loops(self, loops: Iterable[records.LoopRecord]) -> None:
        """Write every loop candidate and its verdict."""
        _write_json(self.loops_path, [records.to_json(loop) for loop in loops])

    def read_loops(self) -> list[records.LoopRecord]:
        """Every loop candidate and its verdict."""
        return [records.loop_from_json(values) for values in self._read_json(self.loops_path)]

    def write_components(self, components: records.Components) -> None:
        """Write which sub-maps share a world frame, and where they lie in it."""
        _write_json(self.components_path, records.to_json(components))

    def read_components(self) -> records.Components:
        """Which sub-maps share a world frame, and where they lie in it."""
        return records.components_from_json(self._read_json(self.components_path))

    def write_map(self, cloud: GaussianCloud) -> None:
        """Write the merged map as a standard 3DGS PLY."""
        from magic_core.gaussians.ply import write_ply

        self.path.mkdir(parents=True, exist_ok=True)
        write_ply(self.map_path, cloud)

    def read_map(self) -> GaussianCloud:
        """The merged map."""
        from magic_core.gaussians.ply import read_ply

        return read_ply(self._existing(self.map_path))

    def read_coarse_map(self) -> GaussianCloud:
        """The sub-maps appended, before the fine stage of merging."""
        from magic_core.gaussians.ply import read_ply

        return read_ply(self._existing(self.coarse_map_path))

    def write_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write metrics.json; NaN and infinity become null."""
        _write_json(self.metrics_path, metrics)

    def read_metrics(self) -> dict[str, Any]:
        """The metrics of the run."""
        return self._read_json(self.metrics_path)

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write the configuration of the run as YAML."""
        text = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
        _write_text(self.config_path, text)

    def read_config(self) -> dict[str, Any]:
        """The configuration of the run."""
        path = self._existing(self.config_path)
        try:
            return yaml.safe_load(path.read_text()) or {}
        except yaml.YAMLError as error:
            raise CorruptData(f"{path}: not readable as YAML ({error})") from error

    def _existing(self, path: Path) -> Path:
        if not path.is_file():
            raise NotFound(
                f"{path}: not in this run folder; the run ended before it was written, or the path "
                "is not a run folder"
            )
        return path

    def _read_json(self, path: Path) -> Any:
        try:
            return json.loads(self._existing(path).read_text())
        except ValueError as error:
            raise CorruptData(f"{path}: not readable as JSON ({error})") from error


def _write_json(path: Path, content: Any) -> None:
    _write_text(path, json.dumps(_finite(content), indent=1, allow_nan=False) + "\n")


def _write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = _partial(path)
    partial.write_text(text)
    partial.replace(path)


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _finite(value: Any) -> Any:
    """JSON knows neither NaN nor infinity nor numpy numbers: they become null and plain ones."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if hasattr(value, "tolist"):
        return _finite(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
