"""The tracking benchmark on a short recording of the exact room."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.slam_config import SlamConfig, SubmapConfig
from magic_agent.tracking import benchmark
from magic_agent.tracking.config import AdamConfig, TrackingConfig
from magic_agent.tracking.trial import Chain
from magic_core.data import Frame, write_replica
from magic_core.errors import ConfigError
from magic_core.evaluation.trajectory import Trajectory
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3
from magic_core.submap import Descriptor, Keyframe, OdometryEdge, Submap, TrackedFrame


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
    stages = {"pyramid", "rotation", "initialisation", "render", "refinement", "verdict"}
    assert set(newton["stages_ms"]) == stages
    assert 0.0 < newton["ms_per_frame"]["median"] <= newton["ms_per_frame"]["p95"]
    assert report["speedup"] is None
    assert len(lines) == 1


def test_bands_hold_every_seed(recording):
    report = benchmark.run(recording, scale=1.0, solvers=("gn",), seeds=(0, 1))
    assert report["seeds"] == [0, 1]
    found = report["solvers"]["gn"]
    alone = [
        benchmark.run(recording, scale=1.0, solvers=("gn",), seeds=(seed,))["solvers"]["gn"]
        for seed in (0, 1)
    ]
    values = [each["mean_ate_m"] for each in alone]
    least, median, largest = found["bands"]["mean_ate_m"]
    assert [least, largest] == pytest.approx(sorted(values))
    assert found["mean_ate_m"] == median == pytest.approx(sum(values) / 2)
    assert least < largest  # the seed does something
    assert found["bands"]["lost_frames"] == [0.0, 0.0, 0.0]


def test_both_solvers_run_side_by_side_and_give_a_speedup(recording):
    quick = SlamConfig(tracking=TrackingConfig(adam=AdamConfig(iterations=12)))
    report = benchmark.run(recording, scale=1.0, frames=4, config=quick)
    assert set(report["solvers"]) == {"gn", "adam"}
    gn, adam = (report["solvers"][name]["ms_per_frame"]["median"] for name in ("gn", "adam"))
    assert report["speedup"] == pytest.approx(adam / gn)
    assert set(report["solvers"]["adam"]["stages_ms"]) >= {"render", "loss", "backward"}


def submap(index: int, poses: list, *, odometry: OdometryEdge | None, lost: tuple = ()) -> Submap:
    frames = [room_frame(pose, number) for number, pose in poses]
    anchor_from_world = se3.inverse(poses[0][1])
    return Submap(
        session="s",
        agent="a",
        index=index,
        camera=CAMERA,
        gaussians=GaussianCloud.empty(),
        keyframes=(Keyframe(frames[0].index, 0.0, np.eye(4), frames[0].colour, frames[0].depth),),
        trajectory=tuple(
            TrackedFrame(number, number / 30, anchor_from_world @ pose, number in lost)
            for number, pose in poses
        ),
        descriptor=Descriptor("none", np.ones(1, np.float32)),
        odometry=odometry,
        world_from_anchor_prior=None,
    )


def test_a_broken_chain_is_judged_part_by_part_and_never_hides_an_error_within_a_part():
    poses = list(enumerate(walk(12)))
    truth = Trajectory.from_poses((number / 30, pose) for number, pose in poses)
    step = se3.inverse(poses[0][1]) @ poses[4][1]
    off = se3.exp([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    right, wrong = (OdometryEdge(0, edge, np.eye(6)) for edge in (step, step @ off))
    errors = []
    for edge in (right, None, wrong):
        chain = Chain()
        chain.add(submap(0, poses[:4], odometry=None))
        chain.add(submap(1, poses[4:], odometry=edge, lost=(6,)))
        errors.append(chain.ate_rmse_m(truth))
        assert chain.breaks == (edge is None)
        assert sum(len(part) for part in chain.parts) == 11  # the lost one is not claimed
    assert errors[0] < 1e-6
    assert errors[1] < 1e-6
    assert errors[2] > 0.01


def test_refuses_unknown_solvers_and_data_without_truth(recording):
    with pytest.raises(ConfigError, match="newton"):
        benchmark.run(recording, solvers=("newton",))

    class Untrue(RoomWalk):
        def __getitem__(self, index: int) -> Frame:
            frame = super().__getitem__(index)
            return Frame(frame.index, frame.timestamp_s, frame.colour, frame.depth)

    with pytest.raises(ConfigError, match="ground truth"):
        benchmark.run_agent(Untrue("agent_0", 2), {"gn": SlamConfig()})


def test_ablations_differ_from_the_default_in_one_thing_each():
    default = TrackingConfig()
    variants = benchmark.ablations(default)
    assert variants["default"] == default
    assert {f"levels={n}" for n in (1, 2, 3, 4)} < set(variants)
    assert sum(name.startswith("initialisation=") for name in variants) == 5
    assert variants["adam"].solver == "adam"
    assert variants["sub-map alone"].window.images == 0
    without = variants["without pose initialisation"]
    assert (without.initialisation, without.rotation_prealignment) == ("constant_velocity", False)
