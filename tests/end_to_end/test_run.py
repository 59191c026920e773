"""`magic run --json`: the contract that scripts depend on (real processes, small flat)."""

import json

import plyfile
import pytest

from magic_cli.run import RunConfig
from magic_core.config import load_yaml
from magic_core.evaluation import RunFolder

CONTRACT = {
    "ate_rmse_m", "components", "frames", "lost_frames", "submaps", "loops", "psnr_db", "ssim",
    "depth_l1_m", "tracking_ms", "mapping_ms", "fps", "merge_s", "wire_bytes_per_submap",
    "gaussians", "peak_rss_bytes", "wall_s",
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(flat, tmp_path_factory):
    """A finished run of all agents on a few frames, and the JSON it printed."""
    from tests.end_to_end.conftest import Processes

    folder = tmp_path_factory.mktemp("run")
    children = Processes(folder)
    out = folder / "out"
    process = children.start(
        "run", "run", str(flat), "--out", str(out), "--json", "--frames", "20",
        "--submap.frames", "10", "--submap.min-frames", "5", "--merge.iterations", "60",
    )  # fmt: skip
    try:
        stdout, _ = process.communicate(timeout=500)
    finally:
        children.stop_all()
    assert process.returncode == 0, children.log("run")
    return RunFolder(out), json.loads(stdout.strip().splitlines()[-1])


def test_the_json_holds_the_contract(finished):
    _, metrics = finished
    assert metrics.keys() >= CONTRACT
    agents = {f"agent_{i}" for i in range(4)}
    assert metrics["ate_rmse_m"].keys() == agents | {"joint"}
    assert metrics["frames"] == 80
    assert metrics["submaps"] == 8
    assert metrics["loops"].keys() == {"detected", "accepted", "rejected"}
    wire = metrics["wire_bytes_per_submap"]
    assert 0 < wire["compact"] < wire["lossless"]
    for name in ("psnr_db", "ssim", "depth_l1_m"):
        assert metrics[name].keys() >= {"train", "novel"}


def test_tracking_and_rendering_are_right_and_not_only_there(finished):
    """Bands far from chance: 20 frames of 160x120 walk about half a metre."""
    _, metrics = finished
    assert all(metrics["ate_rmse_m"][f"agent_{i}"] < 0.03 for i in range(4))
    assert metrics["lost_frames"] == 0
    assert metrics["psnr_db"]["train"] > 20.0
    assert metrics["depth_l1_m"]["train"] < 0.10


def test_the_run_folder_opens_with_other_tools(finished):
    folder, metrics = finished
    vertices = plyfile.PlyData.read(str(folder.map_path))["vertex"]
    assert len(vertices) == metrics["gaussians"]
    assert {"x", "f_dc_0", "opacity", "scale_0", "rot_0"} <= set(vertices.data.dtype.names)
    assert len(folder.read_trajectory("agent_2", "corrected")) == 20
    assert "VERTEX_SE3:QUAT 0 " in folder.posegraph_path.read_text()
    assert load_yaml(RunConfig, folder.config_path).submap.frames == 10
    assert "<html" in folder.report_path.read_text()
