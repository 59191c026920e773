"""An agent on a live source, against a real server."""

from __future__ import annotations

from dataclasses import replace

import pytest

from magic_agent import warmup
from magic_agent.agent import Agent
from magic_agent.config import AgentConfig
from magic_agent.mapping import MappingConfig
from magic_agent.slam import LocalSlam
from magic_agent.slam_config import SubmapConfig
from magic_agent.tally import Tally
from magic_cli.evaluation import agent_metrics
from magic_cli.summary import _left_out
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.evaluation.records import agent_report_from_json, to_json
from magic_core.geometry import Camera
from tests.small_world import DIMENSION, MODEL_ID, look, render, thumbnail

CAMERA = Camera(width=128, height=96, fx=112.0, fy=112.0, cx=63.5, cy=47.5)
CONFIG = AgentConfig(
    mapping=MappingConfig(iterations=8, anchor_iterations=16),
    submap=SubmapConfig(frames=12, min_frames=6),
    threads=1,
)


class Thumbnails:
    """A weak but real descriptor model."""

    model_id, dimension = MODEL_ID, DIMENSION
    describe = staticmethod(thumbnail)


class Walk:
    """A gentle walk; frames are rendered beforehand, as a camera's are not waited for."""

    name, camera = "agent_0", CAMERA

    def __init__(self, count: int) -> None:
        self._frames = []
        for index in range(count):
            pose = look(-0.8 + 0.004 * index, -0.8 + 0.001 * index, 0.002 * index)
            self._frames.append(Frame(index, index / 30, *render(CAMERA, pose)))

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]

    def __iter__(self):
        return iter(self._frames)


def test_warming_up_goes_through_an_anchor_a_tracked_and_a_lost_frame(monkeypatch):
    results, described = [], []

    class Watched(LocalSlam):
        def process(self, frame, **options):
            results.append(super().process(frame, **options))
            return results[-1]

    monkeypatch.setattr(warmup, "LocalSlam", Watched)
    warmup.warm_up_slam(CONFIG, describe=lambda colour: described.append(1) or thumbnail(colour))
    assert [result.lost for result in results] == [False, False, True]
    assert results[0].is_keyframe
    assert results[1].tracked is not None
    assert results[1].tracked.verdict == "ok"
    assert described


async def live(source: Walk, client, tmp_path, rate_hz: float) -> Tally:
    agent = Agent(
        source,
        client,
        session="live",
        name="agent_0",
        config=replace(CONFIG, rate_hz=rate_hz),
        model=Thumbnails(),
        folder=tmp_path / "agent_0",
    )
    return await agent.run()


async def test_a_camera_too_fast_costs_mapping_and_frames_and_the_report_says_so(client, tmp_path):
    source = Walk(60)
    tally = await live(source, client, tmp_path, rate_hz=500.0)
    assert tally.completed
    assert tally.dropped_frames > 0
    assert tally.frames + tally.dropped_frames == len(source)
    assert tally.cut_mapping_steps > 0  # the anchor at least had no time for all its steps
    assert len(tally.late_ms) == tally.frames
    assert max(tally.late_ms) > 1e3 * CONFIG.queue_frames / 500.0

    report = tally.report(camera=CAMERA, dataset="walk", scale=1.0)
    assert agent_report_from_json(to_json(report)) == report
    metrics = agent_metrics([report])
    assert metrics["left_out"] == {
        "frames": tally.dropped_frames,
        "keyframes": tally.skipped_keyframes,
        "mapping_steps": tally.cut_mapping_steps,
        "of_mapping_steps": tally.cut_mapping_steps + tally.mapping_steps,
    }
    rows = dict(_left_out(metrics))
    assert f"{tally.dropped_frames} frames" in rows["left out to keep up"]


async def test_a_slow_camera_costs_no_frame(client, tmp_path):
    tally = await live(Walk(4), client, tmp_path, rate_hz=1.0)
    assert (tally.frames, tally.dropped_frames) == (4, 0)


async def test_a_recording_that_waits_leaves_nothing_out(client, tmp_path):
    tally = await live(Walk(6), client, tmp_path, rate_hz=0.0)
    assert (tally.frames, tally.dropped_frames, tally.skipped_keyframes) == (6, 0, 0)
    assert (tally.cut_mapping_steps, tally.late_ms) == (0, [])
    metrics = agent_metrics([tally.report(camera=CAMERA, dataset="walk", scale=1.0)])
    assert _left_out(metrics) == []


@pytest.mark.parametrize("rate_hz", [-1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate_hz):
    with pytest.raises(ConfigError, match="rate_hz"):
        replace(CONFIG, rate_hz=rate_hz).validate()
