"""Six agents of two places that never overlap, in one session: two maps, no false link."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from magic_core.data import open_dataset
from magic_core.evaluation import RunFolder

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
PLACES = ("redkitchen", "living_room_3agents")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not all((DATA / place).is_dir() for place in PLACES), reason=f"{DATA} is absent"
    ),
]


@pytest.fixture
def six_agents(tmp_path: Path) -> Path:
    """One dataset with the agents of both places."""
    folder = tmp_path / "both"
    for number, place in enumerate(PLACES):
        for agent in range(3):
            recording = folder / f"agent_{3 * number + agent}"
            recording.mkdir(parents=True)
            source = DATA / place / f"agent_{agent}"
            (recording / "results").symlink_to(source / "results", target_is_directory=True)
            shutil.copy(source / "traj.txt", recording)
            shutil.copy(DATA / place / "cam_params.json", recording)
    return folder


def test_two_places_in_one_session_stay_two_components(six_agents, tmp_path, processes):
    assert len(open_dataset(six_agents, scale=0.5)) == 6
    out = tmp_path / "out"
    process = processes.start(
        "run", "run", str(six_agents), "--out", str(out), "--scale", "0.5", "--json",
        "--merge.iterations", "60", "--no-report",
    )  # fmt: skip
    stdout, _ = process.communicate(timeout=7200)
    assert process.returncode == 0, processes.log("run")
    assert json.loads(stdout.strip().splitlines()[-1])["components"] == 2
    components = RunFolder(out).read_components()
    agents = sorted(sorted(members) for members in components.members.values())
    assert agents == [[f"agent_{3 * n + a}" for a in range(3)] for n in range(2)]
