"""Camera faults: detected, recovered from or declared, and never a pose that is not true."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_room import CAMERA, room_frame, walk

from magic_agent.mapping import KeyframeConfig, MappingConfig
from magic_agent.slam_config import SlamConfig, SubmapConfig
from magic_agent.tracking import faults
from magic_agent.tracking.config import GaussNewtonConfig, LostConfig, TrackingConfig
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.geometry import se3

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
CONFIG = SlamConfig(
    tracking=TrackingConfig(gauss_newton=GaussNewtonConfig(levels=3)),
    mapping=MappingConfig(iterations=6, anchor_iterations=12, keyframes=KeyframeConfig(max_gap=4)),
    submap=SubmapConfig(frames=12, min_frames=6, max_lost_frames=3),
    threads=1,
)
START, AFTER = 6, 3
SHORT = {"black": 3, "no depth": 3, "covered": 3, "darker": 5, "brighter": 5, "kidnap": 6}
"""Frames of each fault here; a usable lost frame counts from 3 on instead of 10."""


class TwoWalls:
    """A frame source: a walk along one wall of the room, then one along the wall behind."""

    name, camera = "agent_0", CAMERA

    def __init__(self) -> None:
        behind = se3.exp([0.1, 0.0, -0.3, 0.0, np.pi, 0.0])
        self._poses = [*walk(20), *(behind @ pose for pose in walk(10))]

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index: int) -> Frame:
        return room_frame(self._poses[index], index, noise_seed=index)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))


@pytest.fixture
def shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, frames in SHORT.items():
        monkeypatch.setitem(faults.FAULTS, name, replace(faults.FAULTS[name], frames=frames))


def play(*names: str, config: SlamConfig = CONFIG) -> dict[str, faults.FaultReport]:
    return faults.play_all(TwoWalls(), config, names=names, start=START, after=AFTER)


def test_half_blind_stretches_are_bridged_and_a_covered_lens_is_recovered_from(shortened):
    reports = play("black", "no depth", "covered", "darker")
    for name in ("none", "black", "no depth", "darker"):
        assert reports[name].outcome == "unharmed", name
    covered = reports["covered"]
    assert (covered.outcome, covered.lost_frames, covered.breaks) == ("recovered", 3, 0)
    assert covered.lost_after == 0
    for name, report in reports.items():
        assert report.worst_m < 0.02, name


def test_a_kidnap_is_noticed_at_once_and_declared(shortened):
    report = play("kidnap")["kidnap"]
    assert report.outcome == "declared"
    assert report.lost_after == 0
    assert report.breaks >= 1
    assert report.worst_m < 0.02  # every part is true in itself


def test_a_tracker_that_believes_everything_is_found_out(shortened):
    """What the report is for: without a verdict the same kidnap puts wrong poses into the map."""
    credulous = LostConfig(
        min_inlier_share=0.0, min_visible_share=0.0, max_colour_error=10.0, max_gain=1e6,
        max_jump_m=100.0, max_turn_deg=360.0, min_valid_depth_share=0.0, min_contrast=0.0,
    )  # fmt: skip
    config = replace(CONFIG, tracking=replace(CONFIG.tracking, lost=credulous))
    report = play("kidnap", config=config)["kidnap"]
    assert report.outcome == "wrong"
    assert report.worst_m > 0.1


def test_unknown_faults_are_refused():
    with pytest.raises(ConfigError, match=r"flood.*black"):
        faults.run_faults("anywhere", names=["flood"])


@pytest.mark.slow
@pytest.mark.parametrize("dataset", ["living_room_3agents", "redkitchen"])
def test_faults_on_recordings_never_make_a_wrong_map(dataset):
    if not (DATA / dataset).is_dir():
        pytest.skip(f"needs {DATA / dataset}, which is not in this checkout")
    reports = faults.run_faults(DATA / dataset, agents=["agent_0"])["faults"]["agent_0"]
    for name, report in reports.items():
        assert report["outcome"] != "wrong", name
    assert reports["kidnap"]["outcome"] == "declared"
    assert reports["kidnap"]["lost_after"] == 0
    assert reports["covered"]["outcome"] == "recovered"
    assert reports["covered"]["lost_frames"] == 20
