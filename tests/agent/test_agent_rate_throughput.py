"""The benchmark of a whole agent's speed, on a short recording."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import pytest
from box_room import room_frame, walk

from magic_agent import throughput
from magic_agent.config import AgentConfig
from magic_agent.mapping import MappingConfig
from magic_agent.slam_config import SubmapConfig
from magic_core.data import Frame, write_replica
from magic_core.errors import ConfigError
from magic_core.geometry import Camera

CAMERA = Camera(width=80, height=60, fx=65.0, fy=65.0, cx=39.5, cy=29.5)
CONFIG = AgentConfig(
    mapping=MappingConfig(iterations=3, anchor_iterations=6),
    submap=SubmapConfig(frames=4, min_frames=3),
    threads=1,
)


class RoomWalk:
    name, camera = "agent_0", CAMERA
    _poses = walk(9)

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index: int) -> Frame:
        return room_frame(self._poses[index], index, camera=CAMERA)

    def __iter__(self):
        return (self[index] for index in range(len(self)))


@pytest.fixture
def recording(tmp_path):
    return write_replica([RoomWalk()], tmp_path / "data")


def test_every_frame_and_sub_map_is_counted_and_times_add_up(recording):
    before = os.environ.get("MAGIC_THREADS"), os.sched_getaffinity(0)
    report = throughput.run(recording, threads=1, scale=1.0, config=CONFIG)
    assert json.loads(json.dumps(report)) == report
    found = report["agents"]["agent_0"]
    assert (found["frames"], found["submaps"]) == (9, 3)
    assert found["fps"] == pytest.approx(1e3 / found["wall_ms_per_frame"])
    stages = found["stages_ms_per_frame"]
    beside = stages.pop("encoding, beside them")
    assert beside > 0.0
    assert sum(stages.values()) <= found["wall_ms_per_frame"]
    assert report["slowest_submap_fps"] > 0.0
    assert report["cores"] == 1
    assert (os.environ.get("MAGIC_THREADS"), os.sched_getaffinity(0)) == before


def test_more_threads_than_cores_are_refused(recording):
    config = replace(CONFIG, threads=4096)
    with pytest.raises(ConfigError, match="4096"):
        throughput.run(recording, threads=4096, config=config)
