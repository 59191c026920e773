"""`magic bench server`: what it sends is varied, right, and all of it is stored."""

from __future__ import annotations

import json

import numpy as np
import pytest

from magic_cli.benchmarks import server as bench
from magic_cli.benchmarks import server_recording
from magic_cli.benchmarks.server_recording import RecordedSubmap, Recording, replayed
from magic_core.errors import ConfigError
from magic_core.gaussians import codec
from magic_core.wire import check_blob, check_header, encode_submap, geometry
from tests.small_world import DIMENSION, MODEL_ID, make_submap, path

SUBMAPS = 3


def recording() -> Recording:
    poses = path(0, SUBMAPS)
    walk = tuple(
        RecordedSubmap(
            encode_submap(make_submap(index=i, submaps=SUBMAPS), request_id="recorded"), poses[i]
        )
        for i in range(SUBMAPS)
    )
    return Recording((walk,), MODEL_ID, DIMENSION)


def test_a_replayed_submap_is_a_right_one_and_shares_no_blob_with_any_other() -> None:
    source = recording()
    seen: set[bytes] = set()
    for agent, index in ((0, 0), (0, 1), (0, 4), (1, 0), (1, 4)):
        submap = replayed(source, agent=agent, index=index)
        check_header(submap.header)
        for number, blob in enumerate(submap.blobs):
            check_blob(submap.header, number, blob)
        digests = {blob.sha256 for blob in submap.header.blobs}
        assert seen.isdisjoint(digests)
        seen |= digests
    recorded = codec.decode(source.walks[0][0].encoded.blobs[0]).means
    moved = codec.decode(replayed(source, agent=1, index=4).blobs[0]).means
    np.testing.assert_allclose(moved, recorded, atol=2e-4)


def test_an_agent_walks_to_and_fro_without_a_break() -> None:
    source = recording()
    where = np.eye(4)
    poses = path(0, SUBMAPS)
    for index, place in enumerate((0, 1, 2, 1, 0, 1)):
        header = replayed(source, agent=0, index=index).header
        if index:
            edge = header.odometry.previous_from_anchor
            where = where @ geometry.pose_from_proto(edge)
            assert header.odometry.previous_index == index - 1
        expected = np.linalg.inv(poses[0]) @ poses[place]
        np.testing.assert_allclose(where, expected, atol=1e-9)


def test_it_refuses_fewer_submaps_than_agents() -> None:
    with pytest.raises(ConfigError, match="one for each of 32 agents"):
        bench.ServerBenchmark(submaps=3)


@pytest.mark.slow
def test_a_short_load_is_stored_and_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--agents", "4", "--submaps", "12", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["agents"], result["submaps"]) == (4, 12)
    assert set(result["rpc_ms"]) == {"SubmitSubmap", "GetCorrectedPoses", "QueryLoops"}
    assert all(times["p50"] <= times["p99"] for times in result["rpc_ms"].values())
    assert result["ratio"] == pytest.approx(result["mb_per_s"] / result["disk_mb_per_s"])
    assert result["loop_stalls_over_50ms"] >= 0


@pytest.mark.slow
def test_a_load_that_is_ended_early_keeps_its_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(server_recording, "record", lambda progress: recording())
    assert bench.main(["--agents", "4", "--submaps", "100000", "--seconds", "4", "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert not result["complete"]
    assert 0 < result["submaps"] < 100000
    assert result["rpc_ms"]["SubmitSubmap"]["calls"] == result["submaps"]
