"""Ctrl-C during `magic run` leaves a run folder that every other command can use."""

from __future__ import annotations

import json
import signal

import plyfile
import pytest

from magic_cli.main import run_command
from magic_core.evaluation import RunFolder
from magic_core.evaluation.frame_records import read_frame_records
from tests.end_to_end.conftest import wait_until

pytestmark = pytest.mark.slow  # a whole run with its server and four agents


def frames_seen(out) -> int:
    counts = []
    for path in out.glob("agents/*/frames.csv"):
        counts.append(len(read_frame_records(path)))
    return min(counts) if len(counts) == 4 else 0


@pytest.fixture(scope="module")
def interrupted(flat, tmp_path_factory):
    """A run of four agents that got one SIGINT when each had tracked twelve of 36 frames."""
    from tests.end_to_end.conftest import Processes

    folder = tmp_path_factory.mktemp("interrupted")
    children, out = Processes(folder), folder / "out"
    process = children.start(
        "run", "run", str(flat), "--out", str(out), "--json",
        "--submap.frames", "10", "--submap.min-frames", "5", "--merge.iterations", "20",
    )  # fmt: skip
    try:
        wait_until(lambda: frames_seen(out) >= 12, timeout_s=1200)
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=1200)
    finally:
        children.stop_all()
    assert process.returncode == 0, children.log("run")
    return RunFolder(out), json.loads(stdout.strip().splitlines()[-1]), children.log("run")


def test_what_was_seen_is_mapped_and_measured(interrupted):
    folder, metrics, log = interrupted
    assert "Interrupted" in log
    assert 48 <= metrics["frames"] < 4 * 36
    assert metrics["gaussians"] > 1000
    assert len(plyfile.PlyData.read(folder.map_path)["vertex"]) == metrics["gaussians"]
    for agent in folder.agents():
        assert folder.has_trajectory(agent, "corrected")
        assert folder.has_trajectory(agent, "tracked")
    assert folder.report_path.is_file()
    assert folder.config_path.is_file()


@pytest.mark.parametrize("command", ["loops", "tracking"])
def test_the_other_commands_work_on_it(interrupted, command, capsys):
    folder, _, _ = interrupted
    assert run_command([command, str(folder.path), "--json"]) == 0
    json.loads(capsys.readouterr().out.strip().splitlines()[-1])


def test_it_can_be_measured_again(interrupted, capsys):
    folder, metrics, _ = interrupted
    assert run_command(["eval", str(folder.path), "--json", "--no-report"]) == 0
    again = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert again["frames"] == metrics["frames"]
    assert again["ate_rmse_m"] == pytest.approx(metrics["ate_rmse_m"])


def test_a_ctrl_c_before_anything_was_mapped_ends_with_130(flat, processes, tmp_path):
    process = processes.start("early", "run", str(flat), "--out", str(tmp_path / "out"))
    wait_until(lambda: (tmp_path / "out" / "server" / "log.txt").is_file(), timeout_s=600)
    for _ in range(2):  # whatever the stage, the second one ends at once
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    process.communicate(timeout=600)
    assert process.returncode == 130
    assert "Traceback" not in processes.log("early")
    assert "interrupted" in processes.log("early")
