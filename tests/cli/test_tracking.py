"""`magic tracking` and the per-frame report that agents write."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from magic_agent.frame_report import FrameReport
from magic_agent.slam import LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_cli.main import run_command
from magic_core.data import Frame
from magic_core.errors import CorruptData, NotFound
from magic_core.evaluation.frame_records import FrameLog, read_frame_records
from magic_core.submap import Descriptor
from tests.core.small_flat import small_flat, small_frames


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A real agent's engine on the flat; frames 8 to 10 are black, as with a covered lens."""
    folder = tmp_path_factory.mktemp("run")
    slam = LocalSlam(
        small_flat()[0].camera, SlamConfig(), session="s", agent="agent_0",
        describe=lambda image: Descriptor("none", np.ones(4, np.float32) / 2),
    )  # fmt: skip
    report = FrameReport(folder / "agents" / "agent_0")
    for frame in small_frames(0)[:14]:
        dark = 8 <= frame.index <= 10
        seen = Frame(
            frame.index, frame.timestamp_s,
            np.zeros_like(frame.colour) if dark else frame.colour,
            np.zeros_like(frame.depth) if dark else frame.depth,
        )  # fmt: skip
        report.add(slam.process(seen))
    report.close()
    return folder


def test_every_frame_has_its_line_with_figures(run):
    records = read_frame_records(run / "agents" / "agent_0" / "frames.csv")
    assert [record.frame for record in records] == list(range(14))
    assert records[0].state == "first"
    assert math.isnan(records[0].cost)
    for record in records[1:8]:
        assert record.state in ("ok", "degenerate")
        assert record.cost > 0
        assert 0.5 < record.inlier_share <= 1
        assert record.condition_number > 1
        assert record.tracking_ms > 0


def test_lost_frames_and_what_came_after_are_told(run, capsys):
    assert run_command(["tracking", str(run), "--json", "--frames", "--state", "lost"]) == 0
    printed = capsys.readouterr()
    figures = json.loads(printed.out.strip().splitlines()[-1])["agent_0"]
    assert figures["frames"] == 14
    (stretch,) = figures["lost"]
    assert (stretch["first"], stretch["last"]) == (8, 10)
    assert stretch["then"] in ("recovered", "a new chain")
    assert figures["states"]["lost"] == 3
    assert "lost from frame 8 to 10" in printed.err


def test_an_agent_that_goes_on_after_a_crash_has_each_frame_once(run, tmp_path):
    whole = read_frame_records(run / "agents" / "agent_0" / "frames.csv")
    first = FrameLog(tmp_path)
    for record in whole[:9]:
        first.add(record)  # killed here: never closed
    with first.path.open("a") as file:
        file.write("9,0.3,0,o")  # and in the middle of a line
    second = FrameLog(tmp_path)
    for record in whole[6:]:
        second.add(record)
    second.close()
    again = read_frame_records(second.path)
    assert [record.frame for record in again] == list(range(14))
    assert [r.state for r in again] == [r.state for r in whole]
    assert again[3].cost == pytest.approx(whole[3].cost, rel=1e-8)


def test_a_damaged_report_is_named_and_a_missing_one_too(run, tmp_path, capsys):
    path = tmp_path / "frames.csv"
    text = (run / "agents" / "agent_0" / "frames.csv").read_text()
    path.write_text(text.replace("\n3,", "\nx,", 1))
    with pytest.raises(CorruptData, match="line 5"):
        read_frame_records(path)
    with pytest.raises(NotFound):
        read_frame_records(tmp_path / "nothing.csv")
    assert run_command(["tracking", str(tmp_path)]) == 1
    assert "frames.csv" in capsys.readouterr().err
