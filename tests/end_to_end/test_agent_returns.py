"""An agent that is killed goes on where its last sub-map ended when it returns (real processes)."""

import asyncio
import json
import random
import signal
import time

import numpy as np
import pytest

from magic_agent.client import MagicClient
from magic_core.evaluation import RunFolder
from tests.end_to_end.conftest import first_line, wait_for

AGENT = "agent_1"


def arguments(flat, target: str, out) -> list[str]:
    options = ["--submap.frames", "9", "--submap.min-frames", "5", "--progress", "json", "--json"]
    place = ["--server", target, "--session", "flat", "--name", AGENT, "--out", str(out)]
    return ["agent", str(flat), *place, *options]


@pytest.mark.slow
def test_an_agent_killed_twice_leaves_one_whole_trajectory(flat, processes, tmp_path):
    server = processes.start(
        "server", "serve", "--data-dir", str(tmp_path / "store"), "--port", "0",
        "--progress", "json",
    )  # fmt: skip
    target, out = first_line(server)["target"], tmp_path / "out"
    rng = random.Random(5)

    first = processes.start("first", *arguments(flat, target, out))
    wait_for(first, "frames", 12)
    time.sleep(rng.uniform(0.0, 1.0))
    first.send_signal(signal.SIGKILL)
    first.wait()
    reported = RunFolder(out).read_agent_report(AGENT)
    assert reported.submaps >= 1  # a killed agent is in the report as far as it came

    # The second life sees more of the server's sub-maps, and dies as suddenly.
    second = processes.start("second", *arguments(flat, target, out))
    wait_for(second, "frames", 21)
    time.sleep(rng.uniform(0.0, 1.0))
    second.send_signal(signal.SIGKILL)
    second.wait()

    third = processes.start("third", *arguments(flat, target, out))
    stdout, _ = third.communicate(timeout=300)
    assert third.returncode == 0, processes.log("third")
    assert "going on behind sub-map" in processes.log("third")
    figures = json.loads(stdout.strip().splitlines()[-1])
    assert figures["frames"] == 36
    assert figures["lost_frames"] == 0

    parts, headers = asyncio.run(stored(target))
    frames = [frame for part in parts for frame in part.frames]
    assert [frame.frame_index for frame in frames] == list(range(36))
    assert len({part.component for part in parts}) == 1
    assert [header.HasField("odometry") for header in headers] == [False, *[True] * len(parts[1:])]
    estimated = np.array([frame.world_from_camera[:3, 3] for frame in frames])
    assert rmse_m(estimated, true_positions(flat)) < 0.02
    assert not list((out / "agents" / AGENT / "spool").iterdir())
    report = RunFolder(out).read_agent_report(AGENT)
    assert report.frames == len(report.tracking_ms) == 36
    assert report.submaps == len(report.wire_bytes) == len(parts)


async def stored(target: str):
    """The agent's trajectory, and the headers of its sub-maps."""
    async with MagicClient(target) as client:
        parts = await client.get_trajectory("flat", AGENT)
        headers = [(await client.get_submap(part.submap))[1] for part in parts]
        return parts, headers


def true_positions(flat) -> np.ndarray:
    """(n, 3) of the recording's own trajectory."""
    rows = np.loadtxt(flat / AGENT / "traj.txt").reshape(-1, 4, 4)
    return rows[:, :3, 3]


def rmse_m(estimated: np.ndarray, truth: np.ndarray) -> float:
    """RMSE of positions (n, 3) after the best rigid alignment."""
    a, b = estimated - estimated.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return float(np.sqrt(((a @ u @ flip @ vt - b) ** 2).sum(axis=1).mean()))
