"""Run folders, their measurement and their report, on a small map made from the synthetic flat."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from magic_core.data.synthetic.paths import walk_poses
from magic_core.errors import CorruptData, NotFound
from magic_core.evaluation import (
    AgentReport,
    Components,
    LoopRecord,
    PlacedAnchor,
    RunFolder,
    Trajectory,
    WireBytes,
    evaluate_run,
    ground_truth_of,
    measure_trajectories,
    write_report,
)
from magic_core.evaluation.vantage import plan_frame, up_direction
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3
from tests.core.small_flat import small_flat, small_frames

WORLD_FROM_FLAT = se3.exp([2.0, -1.0, 0.5, 0.4, -0.2, 1.0])
KEYFRAMES = tuple(range(0, 24, 4))


def submap(agent: str, index: int) -> str:
    return f"sessions/s/agents/{agent}/submaps/{index}"


def splats_of(frame, camera, pose) -> GaussianCloud:
    """One Gaussian per pixel of a frame: a crude map, but a real one."""
    points = se3.transform_points(pose, camera.back_project(frame.depth).reshape(-1, 3))
    n = len(points)
    size = (0.45 * frame.depth / camera.fx).reshape(-1, 1)
    return GaussianCloud.from_arrays(
        points, np.tile([1.0, 0, 0, 0], (n, 1)), scales=np.repeat(size, 3, 1),
        opacities=np.full(n, 0.95), colours=frame.colour.reshape(-1, 3) / 255.0,
    )  # fmt: skip


def make_run(folder, *, agents: int = 2) -> RunFolder:
    """A run whose corrected poses are the truth in another world frame."""
    run = RunFolder(folder).create()
    clouds, anchors, members = [], {}, {}
    for number, source in enumerate(small_flat()[:agents]):
        truth = ground_truth_of(source)
        assert truth is not None
        corrected = truth.transformed(WORLD_FROM_FLAT)
        run.write_trajectory(source.name, "corrected", corrected)
        odometry = se3.inverse(corrected.world_from_camera[0])
        run.write_trajectory(source.name, "tracked", corrected.transformed(odometry))
        run.write_agent_report(
            AgentReport(
                agent=source.name, frames=24, lost_frames=0, submaps=2, keyframes=KEYFRAMES,
                camera=source.camera, dataset="synthetic://flat",
                tracking_ms=tuple(np.linspace(10, 20, 24)), mapping_ms=(30.0,) * 24,
                wire_bytes=(WireBytes(1_000_000, 4_000_000),) * 2, submap_first_frames=(0, 12),
            )
        )  # fmt: skip
        members[source.name] = (0, 1)
        for index in (0, 1):
            pose = corrected.world_from_camera[12 * index]
            anchors[submap(source.name, index)] = PlacedAnchor("c0", pose)
        clouds += [
            splats_of(small_frames(number)[k], source.camera, corrected.world_from_camera[k])
            for k in (4, 16)
        ]
    run.write_components(Components(3, {"c0": members}, anchors))
    run.write_loops(
        [
            LoopRecord(submap("agent_0", 1), submap("agent_1", 1), 0.91, "accepted", inliers=60),
            LoopRecord(submap("agent_0", 0), submap("agent_1", 0), 0.62, "rejected", "FEW_INLIERS"),
        ]
    )
    run.write_map(GaussianCloud.concatenate(clouds))
    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "flat")


def test_records_come_back_as_they_were_written(run):
    report = run.read_agent_report("agent_1")
    assert report.keyframes == KEYFRAMES
    assert report.camera == small_flat()[1].camera
    assert report.wire_bytes[1] == WireBytes(1_000_000, 4_000_000)
    assert [loop.accepted for loop in run.read_loops()] == [True, False]
    components = run.read_components()
    assert components.members == {"c0": {"agent_0": (0, 1), "agent_1": (0, 1)}}
    assert components.largest() == "c0"
    assert run.agents() == ["agent_0", "agent_1"]
    run.write_config({"tracking": {"solver": "gn"}, "scale": 0.5})
    assert run.read_config() == {"tracking": {"solver": "gn"}, "scale": 0.5}


def test_what_was_never_written_is_not_found(tmp_path):
    empty = RunFolder(tmp_path / "nothing")
    assert empty.agents() == []
    for read in (empty.read_map, empty.read_metrics, empty.read_loops, empty.read_components,
                 lambda: empty.read_trajectory("a", "tracked")):  # fmt: skip
        with pytest.raises(NotFound, match="nothing"):
            read()


def test_spoiled_json_is_named(tmp_path):
    folder = RunFolder(tmp_path)
    folder.loops_path.write_text("[{]")
    with pytest.raises(CorruptData, match=r"loops\.json"):
        folder.read_loops()
    folder.components_path.write_text('{"revision": 1}')
    with pytest.raises(CorruptData, match="components"):
        folder.read_components()


def test_unknown_keys_of_newer_writers_are_ignored(tmp_path):
    folder = RunFolder(tmp_path)
    loop = {"source": "a", "target": "b", "similarity": 0.5, "verdict": "accepted", "new": [1]}
    folder.loops_path.write_text(json.dumps([loop]))
    assert folder.read_loops()[0].similarity == 0.5


def test_metrics_are_strict_json(tmp_path):
    folder = RunFolder(tmp_path)
    folder.write_metrics({"a": float("nan"), "b": np.float32(1.5), "c": (np.arange(3), np.inf)})

    def refuse(constant: str) -> float:
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(folder.metrics_path.read_text(), parse_constant=refuse)
    assert content == {"a": None, "b": 1.5, "c": [[0, 1, 2], None]}


def test_measures_poses_and_map(run):
    metrics = evaluate_run(run, sources=small_flat()[:2], views_per_kind=4)
    assert set(metrics["ate_rmse_m"]) == {"agent_0", "agent_1", "joint"}
    assert all(value < 1e-6 for value in metrics["ate_rmse_m"].values())
    assert metrics["views"] == {"train": 4, "novel": 4}
    assert metrics["components"] == 1
    for kind in ("train", "novel"):
        assert metrics["psnr_db"][kind] > 17  # a crude map: measured 19.6
        assert 0.35 < metrics["ssim"][kind] < 1  # measured 0.46
        assert metrics["depth_l1_m"][kind] < 0.2  # silhouettes are soft at this size
        assert metrics["psnr_db"][f"{kind}_coarse"] is None
    assert "map_coarse.ply" in metrics["unmeasured"]["coarse"]
    json.dumps(metrics, allow_nan=False)


def test_the_map_before_refinement_is_measured_beside_the_final_one(run, tmp_path):
    again = make_run(tmp_path / "both")
    fine = run.read_map()
    again.map_path.replace(again.coarse_map_path)
    again.write_map(fine.select(np.arange(0, len(fine), 3)))
    metrics = evaluate_run(again, sources=small_flat()[:2], views_per_kind=4)
    whole = evaluate_run(run, sources=small_flat()[:2], views_per_kind=4)
    for name in ("psnr_db", "ssim", "depth_l1_m"):
        assert metrics[name]["train_coarse"] == pytest.approx(whole[name]["train"], rel=1e-6)
        assert metrics[name]["novel_coarse"] == pytest.approx(whole[name]["novel"], rel=1e-6)
    assert metrics["psnr_db"]["train"] < metrics["psnr_db"]["train_coarse"] - 0.3


def test_agents_are_measured_one_by_one(run):
    metrics = evaluate_run(run, sources=small_flat()[:2], views_per_kind=4)
    agents = metrics["per_agent"]
    assert set(agents) == {"agent_0", "agent_1"}
    for kind in ("train", "novel"):  # two views of each kind per agent, so means of means agree
        parts = [agents[name]["psnr_db"][kind] for name in agents]
        assert np.mean(parts) == pytest.approx(metrics["psnr_db"][kind])


def test_relative_errors_are_those_of_each_agents_motion(run):
    metrics = evaluate_run(run, sources=small_flat()[:2], views_per_kind=1)
    recorded = run.read_trajectory("agent_0", "ground_truth").timestamps_s
    assert (set(metrics["rpe_rmse"]) == {"agent_0", "agent_1"}) == (np.ptp(recorded) >= 1.0)
    assert all(error["translation_m"] < 1e-6 for error in metrics["rpe_rmse"].values())


def test_without_weights_lpips_is_null_and_says_why(run, monkeypatch):
    monkeypatch.setattr("magic_core.evaluation.lpips.find_weights", lambda given: None)
    metrics = evaluate_run(run, sources=small_flat()[:2], views_per_kind=1)
    assert set(metrics["lpips"].values()) == {None}
    assert "MAGIC_LPIPS_WEIGHTS" in metrics["unmeasured"]["lpips"]


def test_a_map_at_wrong_poses_measures_worse(run, tmp_path):
    moved = make_run(tmp_path / "moved")
    forward = run.read_trajectory("agent_0", "corrected").world_from_camera[0, :3, 2]
    shift = se3.from_rotation_translation(np.eye(3), 0.4 * forward)
    moved.write_map(run.read_map().transformed(shift))
    good = evaluate_run(run, sources=small_flat()[:2], views_per_kind=2)
    bad = evaluate_run(moved, sources=small_flat()[:2], views_per_kind=2)
    assert bad["psnr_db"]["train"] < good["psnr_db"]["train"] - 2
    assert bad["depth_l1_m"]["novel"] > good["depth_l1_m"]["novel"] + 0.1


def test_only_agents_of_the_largest_component_count_jointly(tmp_path):
    run = make_run(tmp_path / "split", agents=3)
    whole = run.read_components()
    members = {"c0": {"agent_0": (0, 1), "agent_1": (0, 1)}, "c1": {"agent_2": (0, 1)}}
    anchors = {
        name: PlacedAnchor("c1" if "agent_2" in name else "c0", anchor.world_from_anchor)
        for name, anchor in whole.anchors.items()
    }
    run.write_components(Components(4, members, anchors))
    lost = run.read_trajectory("agent_2", "corrected").transformed(se3.exp([9, 9, 9, 1, 1, 1]))
    run.write_trajectory("agent_2", "corrected", lost)
    metrics = evaluate_run(run, sources=small_flat(), views_per_kind=2)
    accuracy = measure_trajectories(run)
    assert accuracy.joint_agents == ("agent_0", "agent_1")
    assert metrics["ate_rmse_m"]["joint"] < 1e-6
    assert metrics["ate_rmse_m"]["agent_2"] < 1e-6  # its own frame is as good as any
    assert metrics["components"] == 2


def test_an_agent_split_between_components_counts_with_the_frames_of_each(tmp_path):
    run = make_run(tmp_path / "torn", agents=2)
    whole = run.read_components()
    members = {"c0": {"agent_0": (0, 1), "agent_1": (0,)}, "c1": {"agent_1": (1,)}}
    run.write_components(Components(5, members, whole.anchors))
    torn = run.read_trajectory("agent_1", "corrected")
    torn.world_from_camera[12:] = se3.exp([5, 0, 0, 0, 0, 1]) @ torn.world_from_camera[12:]
    run.write_trajectory("agent_1", "corrected", torn)
    metrics = evaluate_run(run, sources=small_flat()[:2], views_per_kind=2)
    assert metrics["ate_rmse_m"]["joint"] < 1e-6


def test_a_run_without_truth_or_map_is_measured_as_far_as_possible(tmp_path):
    run = RunFolder(tmp_path / "short").create()
    metrics = evaluate_run(run, sources=[])
    assert metrics["ate_rmse_m"] == {"joint": None}
    assert set(metrics["psnr_db"]) == {"train", "novel", "train_coarse", "novel_coarse"}
    assert set(metrics["psnr_db"].values()) == {None}
    assert "map.ply" in metrics["unmeasured"]["maps"]
    write_report(run, sources=[])
    assert "<h1>short</h1>" in run.report_path.read_text()


def test_the_report_is_complete_and_needs_nothing_else(run):
    run.write_metrics(evaluate_run(run, sources=small_flat()[:2], views_per_kind=2))
    write_report(run, sources=small_flat()[:2], views_per_kind=2)
    page = run.report_path.read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(links) == 2 + 4 * 4 + 1  # overview, plans, four views of four pictures, timing
    assert all(link.startswith("data:image/") for link in links)
    assert "http" not in re.sub(r"data:image/[^\"]*", "", page)
    for text in ("agent_0", "agent_1", "FEW_INLIERS", "New views", "Trajectories from above"):
        assert text in page
    assert "{{" not in page
    picture = cv2.imread(str(run.overview_path))
    assert picture.shape[0] > 500
    assert picture.std() > 20


def test_an_agent_that_left_no_report_is_still_listed(tmp_path):
    run = make_run(tmp_path / "killed")
    run.agent_report_path("agent_1").unlink()
    write_report(run, sources=small_flat()[:2], views_per_kind=1)
    assert "left no report" in run.report_path.read_text()


def test_up_is_found_however_the_world_is_turned():
    poses = np.concatenate([walk_poses(a, 120, rng=np.random.default_rng(a)) for a in range(3)])
    poses[:, :3, :3] @= se3.rotation_exp([0, 0, np.deg2rad(2)])  # held a little askew
    turned = WORLD_FROM_FLAT @ poses
    expected = WORLD_FROM_FLAT[:3, :3] @ (0, 0, 1)
    assert up_direction(turned) @ expected > np.cos(np.deg2rad(4))
    frame = plan_frame([Trajectory(np.arange(len(turned), dtype=float), turned)])
    np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame.axes) == pytest.approx(1.0)
