"""The mapping benchmark on a short recording of the exact room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.mapping import MappingBudget, MappingConfig, benchmark
from magic_agent.mapping.segments import segments_of
from magic_agent.slam_config import SlamConfig, SubmapConfig
from magic_core.data import Frame, open_dataset, write_replica
from magic_core.errors import ConfigError
from magic_core.geometry import se3

CONFIG = SlamConfig(
    mapping=MappingConfig(iterations=4, anchor_iterations=8, max_gaussians=20_000),
    submap=SubmapConfig(frames=6, min_frames=3),
)


class RoomWalk:
    """A frame source: a walk through the room."""

    name, camera = "agent_0", CAMERA

    def __init__(self, *, truth: bool = True) -> None:
        self._poses = walk(11)
        self._truth = truth

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index: int) -> Frame:
        frame = room_frame(self._poses[index], index, noise_seed=index)
        return frame if self._truth else replace(frame, world_from_camera=None)

    def __iter__(self):
        return (self[index] for index in range(len(self)))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_replica([RoomWalk()], tmp_path_factory.mktemp("room") / "data")


@pytest.fixture(scope="module")
def report(recording: Path) -> dict:
    return benchmark.run(recording, scale=0.5, config=CONFIG, seeds=(0,))


def test_every_schedule_runs_with_its_own_and_with_the_others_budget(report):
    assert json.loads(json.dumps(report)) == report
    variants = report["variants"]
    assert set(variants) == {
        "paper", "ours", "ours / iterations of paper", "ours / time of paper",
        "paper / iterations of ours", "paper / time of ours",
    }  # fmt: skip
    steps = {name: found["iterations_per_frame"] for name, found in variants.items()}
    assert steps["ours / iterations of paper"] == pytest.approx(steps["paper"])
    assert steps["paper / iterations of ours"] == pytest.approx(steps["ours"])
    assert steps["paper"] > 5 * steps["ours"]


def test_views_are_those_of_keyframes_and_of_frames_never_mapped(report):
    for found in report["variants"].values():
        assert found["views"]["new_views"] == 2  # frames 3 and 8
        assert found["views"]["keyframes"] >= 2
        assert found["psnr_db"]["keyframes"]["mean"] > found["psnr_db"]["new_views"]["mean"] > 10.0


def test_gains_are_ours_minus_the_papers_at_equal_budget(report):
    psnr = {name: v["psnr_db"]["new_views"]["mean"] for name, v in report["variants"].items()}
    gains = {name: gain["psnr_db"]["new_views"] for name, gain in report["gains"].items()}
    assert gains["iterations of paper"]["mean"] == pytest.approx(
        psnr["ours / iterations of paper"] - psnr["paper"]
    )
    assert gains["time of ours"]["low"] == pytest.approx(
        psnr["ours"] - psnr["paper / time of ours"]
    )


def test_a_budget_is_spread_over_the_keyframes_and_never_exceeded():
    allowance = benchmark.Allowance("iterations", 900, keyframes=tuple(range(0, 45, 5)))
    assert allowance.budget(spent=0, number=0) == MappingBudget(iterations=100)
    assert allowance.budget(spent=100, number=4).iterations == 400
    assert allowance.budget(spent=500, number=8).iterations == 400
    assert allowance.budget(spent=901, number=8).iterations == 0
    assert allowance.budget(spent=0, number=0).seconds is None


def test_what_goes_beyond_a_schedules_own_steps_is_for_closing_the_sub_map():
    ours = benchmark.Allowance("iterations", 900, keyframes=(0, 7, 9), most_iterations=14)
    assert [ours.budget(spent=14 * n, number=n).iterations for n in range(4)] == [14, 14, 14, 858]
    timed = replace(ours, unit="seconds", amount=30.0)
    assert timed.budget(spent=0.0, number=0) == MappingBudget(iterations=14, seconds=10.0)
    assert timed.budget(spent=1.0, number=3).seconds == pytest.approx(29.0)


def test_true_and_tracked_poses_cut_the_same_sub_maps(recording):
    source = open_dataset(recording, scale=1.0)[0]
    true, tracked = (segments_of(source, CONFIG, poses) for poses in ("truth", "tracked"))
    assert [len(s.frames) for s in true] == [len(s.frames) for s in tracked] == [6, 5]
    for a, b in zip(true, tracked, strict=True):
        error = se3.log(se3.inverse(a.anchor_from_camera[-1]) @ b.anchor_from_camera[-1])
        assert 0.0 < abs(error).max() < 0.02
    assert true[0].anchor_from_next is not None
    assert true[-1].anchor_from_next is None


def test_data_without_truth_needs_tracked_poses():
    with pytest.raises(ConfigError, match="--poses tracked"):
        segments_of(RoomWalk(truth=False), CONFIG, "truth")
