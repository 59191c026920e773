"""The tracking benchmark on a short recording of the exact room."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.slam_config import SlamConfig, SubmapConfig
from magic_agent.tracking import benchmark
from magic_agent.tracking.config import TrackingConfig
from magic_core.data import Frame, write_replica
from magic_core.errors import ConfigError


class RoomWalk:
    """A frame source: a walk through the room."""

    def __init__(self, name: str, count: int) -> None:
        self.name = name
        self.camera = CAMERA
        self._poses = walk(count)

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index: int) -> Frame:
        return room_frame(self._poses[index], index, noise_seed=index)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_replica([RoomWalk("agent_0", 9)], tmp_path_factory.mktemp("room") / "data")


def test_reports_accuracy_and_time_of_a_solver_as_json(recording):
    lines = []
    # Short sub-maps, so that the walk crosses a seam.
    config = SlamConfig(submap=SubmapConfig(frames=5, min_frames=3))
    report = benchmark.run(
        recording, scale=1.0, solvers=("gn",), config=config, progress=lines.append
    )
    assert json.loads(json.dumps(report)) == report
    newton = report["solvers"]["gn"]
    assert newton["lost_frames"] == newton["breaks"] == 0
    assert 0.0 < newton["ate_rmse_m"]["agent_0"] < 0.02
    assert newton["mean_ate_m"] == newton["ate_rmse_m"]["agent_0"]
    assert set(newton["stages_ms"]) == {"pyramid", "initialisation", "render", "refinement"}
    assert 0.0 < newton["ms_per_frame"]["median"] <= newton["ms_per_frame"]["p95"]
    assert report["speedup"] is None
    assert len(lines) == 1


def test_refuses_unknown_solvers_and_data_without_truth(recording):
    with pytest.raises(ConfigError, match="newton"):
        benchmark.run(recording, solvers=("newton",))

    class Untrue(RoomWalk):
        def __getitem__(self, index: int) -> Frame:
            frame = super().__getitem__(index)
            return Frame(frame.index, frame.timestamp_s, frame.colour, frame.depth)

    with pytest.raises(ConfigError, match="ground truth"):
        benchmark.run_agent(Untrue("agent_0", 2), SlamConfig())


def test_ablations_differ_from_the_default_in_one_thing_each():
    default = TrackingConfig()
    variants = benchmark.ablations(default)
    assert variants["default"] == default
    assert {f"levels={n}" for n in (1, 2, 3, 4)} < set(variants)
    assert sum(name.startswith("initialisation=") for name in variants) == 5
    assert variants["adam"].solver == "adam"
    assert variants["sub-map alone"].window.images == 0
