"""The pages on data: their worked example runs, and their tables say what the code does."""

from __future__ import annotations

import re
import types
from pathlib import Path

import cv2
import numpy as np
import pytest

from magic_core.data import check_dataset, discovery
from magic_core.data.discovery import LAYOUTS, Layout, open_dataset
from magic_core.data.intrinsics import read_intrinsics
from magic_core.errors import DataError
from magic_core.geometry import Camera
from tests.core.small_flat import small_flat, small_frames

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture
def seven_scenes(monkeypatch):
    """The page's example as a module, and its line in the table."""
    module_text, line = re.findall(
        r"```python\n(.*?)```", (DOCS / "adding-a-data-source.md").read_text(), re.DOTALL
    )
    module = types.ModuleType("seven_scenes")
    monkeypatch.setitem(__import__("sys").modules, "seven_scenes", module)
    exec(module_text, module.__dict__)
    layout = eval(line, {**module.__dict__, "Layout": Layout})
    monkeypatch.setattr(discovery, "LAYOUTS", (layout, *LAYOUTS))
    return module


def write_sequence(folder, camera: Camera):
    """Frames of the flat as the example's camera would have stored them."""
    folder.mkdir()
    flat = small_flat()[0].camera
    u, v = cv2.initUndistortRectifyMap(
        flat.matrix, np.zeros(5), np.eye(3), camera.matrix, (camera.width, camera.height),
        cv2.CV_32FC1,
    )  # fmt: skip
    for k, frame in enumerate(small_frames(0)[:20:2]):
        colour = cv2.remap(frame.colour[..., ::-1].copy(), u, v, cv2.INTER_LINEAR)
        depth = cv2.remap(frame.depth, u, v, cv2.INTER_NEAREST)
        units = np.where(depth > 0, np.rint(depth * 1000), 65535).astype(np.uint16)
        units[:20] = 65535
        cv2.imwrite(str(folder / f"frame-{k:06d}.color.png"), colour)
        cv2.imwrite(str(folder / f"frame-{k:06d}.depth.png"), units)
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", frame.world_from_camera)
    return folder


def test_the_worked_example_reads_its_layout(seven_scenes, tmp_path):
    folder = write_sequence(tmp_path / "seq-01", seven_scenes.CAMERA)
    (source,) = open_dataset(folder, scale=0.5)
    assert len(source) == 10
    assert (source[3].depth[:9] == 0).all()
    np.testing.assert_allclose(
        source[3].world_from_camera, small_frames(0)[6].world_from_camera, atol=1e-9
    )
    report = check_dataset(folder)
    assert report.ok, report.findings
    assert "7-Scenes" in report.findings[0].detail
    (folder / "frame-000004.depth.png").unlink()
    with pytest.raises(DataError, match=r"frame-000004\.depth\.png: missing"):
        open_dataset(folder)


def test_every_layout_has_its_line_on_the_page_of_own_data():
    page = (DOCS / "own-data.md").read_text()
    for layout in LAYOUTS:
        assert re.search(rf"^\| {re.escape(layout.name)}\b", page, re.MULTILINE), layout.name


def test_the_example_of_intrinsics_is_read(tmp_path):
    (example,) = re.findall(r"```json\n(.*?)```", (DOCS / "own-data.md").read_text(), re.DOTALL)
    (tmp_path / "cam_params.json").write_text(example)
    intrinsics = read_intrinsics(tmp_path / "cam_params.json")
    assert (intrinsics.camera.width, intrinsics.depth_scale) == (640, 1000.0)
