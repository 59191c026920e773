"""Every example runs as its first lines say."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest

from magic_core.data import open_dataset, write_replica
from magic_core.data.synthetic import SyntheticConfig, synthetic_flat
from magic_core.gaussians.ply import read_ply
from magic_server.config import ListenConfig, ServerConfig
from magic_server.server import Server

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
pytestmark = pytest.mark.slow


def example(name: str):
    spec = importlib.util.spec_from_file_location(f"example_{name[:2]}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """One walk through the flat, on disk."""
    config = SyntheticConfig(agents=1, frames=40, width=160, height=120, detail="draft")
    return write_replica(synthetic_flat(config), tmp_path_factory.mktemp("flat") / "data")


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    """What the example of three agents leaves behind."""
    return tmp_path_factory.mktemp("three")


def test_every_example_is_listed():
    listed = (EXAMPLES / "README.md").read_text()
    names = [path.name for path in sorted(EXAMPLES.glob("0*.py"))]
    assert len(names) == 5
    clients = [f"clients/{path.name}" for path in sorted((EXAMPLES / "clients").iterdir())]
    assert len(clients) == 2
    assert all(name in listed for name in [*names, *clients])


def test_a_single_agent_tracks_a_recording(recording, capsys):
    error_m = example("01_single_agent").main(str(recording))
    assert error_m is not None
    assert error_m < 0.05
    assert "Gaussians" in capsys.readouterr().out


async def test_three_agents_meet_in_one_map(stored):
    assert await example("02_three_agents").main(stored) == 1
    assert len(read_ply(stored / "map.ply")) > 1000


async def test_a_played_recording_is_mapped_live(recording, tmp_path):
    config = ServerConfig(data_dir=tmp_path / "server", listen=ListenConfig(port=0))
    async with Server(config) as server:
        live = example("03_live_camera")
        assert await live.main(str(recording), server.address, str(tmp_path / "live")) > 5


async def test_an_image_is_placed_in_the_stored_map(stored, tmp_path):
    shutil.copytree(stored / "server", tmp_path / "server")
    dataset = example("02_three_agents").DATASET
    async with Server(ServerConfig(data_dir=tmp_path / "server", listen=ListenConfig(port=0))) as s:
        pose = await example("04_relocalise").main(dataset, "7", s.address, "flat")
        assert pose is not None
        truth = [open_dataset(dataset)[0][i].world_from_camera for i in (0, 7)]
        assert truth[0] is not None
        assert truth[1] is not None
        expected = np.linalg.norm(truth[1][:3, 3] - truth[0][:3, 3])
        assert abs(np.linalg.norm(pose[:3, 3]) - expected) < 0.05
        path = await example("05_read_the_map").main(s.address, str(tmp_path / "view.png"))
        assert path.stat().st_size > 5000
