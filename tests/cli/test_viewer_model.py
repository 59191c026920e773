"""What the viewer shows, without a browser: frames, level of detail, words."""

from __future__ import annotations

import io
import zipfile
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from magic_cli.main import run_command
from magic_cli.viewer.detail import covariances, keep_every, thinned
from magic_cli.viewer.panel import trajectories_zip
from magic_cli.viewer.vantage import FIELD_OF_VIEW_RAD, above, outside, up_of
from magic_cli.viewer.words import agents_text, loop_text, loop_title, summary_text
from magic_core.geometry import se3
from magic_core.render import Rasteriser
from magic_core.wire.records import AgentInfo, CorrectedPose, LoopCandidate
from tests.small_world import make_submap
from tests.viewed_session import viewed_session


def test_one_component_stands_in_its_own_world_frame():
    view = viewed_session((0, 1))
    for name, pose in view.world_from_anchor().items():
        np.testing.assert_allclose(pose, view.snapshot.poses[name].world_from_anchor)


def test_components_stand_side_by_side():
    view = viewed_session((0,), (1,))
    anchors = view.world_from_anchor()
    first, second = (
        np.concatenate(
            [
                se3.transform_points(pose, view.submaps[name].cloud.means)[:, 0]
                for name, pose in anchors.items()
                if agent in name
            ]
        )
        for agent in ("agent_0", "agent_1")
    )
    # The maps, not only the paths, which are short in a large room; strays may reach further.
    assert np.quantile(second, 0.05) - np.quantile(first, 0.95) > 0.9


def test_tracked_poses_follow_the_odometry_from_the_first_sub_map():
    view = viewed_session((0,))
    names = list(view.submaps)
    moved = se3.exp([0.3, 0.0, 0.1, 0.0, 0.2, 0.0])
    old = view.snapshot.poses[names[1]]
    view.snapshot.poses[names[1]] = CorrectedPose(
        old.submap, old.component, old.world_from_anchor @ moved
    )
    tracked = view.tracked()
    np.testing.assert_allclose(tracked[names[1]], old.world_from_anchor, atol=1e-9)
    assert not np.allclose(view.world_from_anchor()[names[1]], old.world_from_anchor, atol=0.1)


@pytest.mark.parametrize("components", [((0,),), ((0, 1),), ((0,), (1,)), ((0,), (1,), (2,))])
def test_the_whole_map_is_seen_beside_the_panel(components):
    view = viewed_session(*components)
    anchors = view.world_from_anchor()
    up = up_of(view, anchors)
    position, look_at = outside(view, anchors, up)
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    seen = []
    for name, pose in anchors.items():
        submap = view.submaps[name]
        path, means = submap.path[:, :3, 3], submap.cloud.means
        below = means[~above(means, path, pose[:3, :3].T @ up)]
        seen += [se3.transform_points(pose, path), se3.transform_points(pose, below)]
    axes = np.stack([right, np.cross(right, forward), forward])
    x, y, z = axes @ (np.concatenate(seen) - position).T
    assert z.min() > 0
    upwards = y / z / np.tan(FIELD_OF_VIEW_RAD / 2)
    across = x / z / np.tan(FIELD_OF_VIEW_RAD / 2) / 1.6  # of a wide page, the panel at its right
    bottom, top = np.quantile(upwards, (0.02, 0.98))  # stray Gaussians may lie outside
    left, right_end = np.quantile(across, (0.02, 0.98))
    assert -1.05 < bottom < top < 1.05
    assert -1.05 < left < right_end < 0.5
    assert max((top - bottom) / 2, (right_end - left) / 1.4) > 0.7  # and it fills what is free


def test_thinning_keeps_the_limit_and_shows_the_same():
    submap = make_submap(agent=0)
    cloud = submap.gaussians
    step = keep_every(len(cloud), 200)
    few = thinned(cloud, step)
    assert len(few) <= 200
    assert step == 4
    left_out = cloud.select(np.arange(0, len(cloud), step))
    rasteriser = Rasteriser(1)
    whole, merged, holed = (
        rasteriser.render(some, submap.camera, np.eye(4)).colour for some in (cloud, few, left_out)
    )
    assert np.mean((merged - whole) ** 2) < 0.5 * np.mean((holed - whole) ** 2)


def test_covariances_are_those_of_axes_and_scales():
    cloud = make_submap(agent=0).gaussians.transformed(se3.exp([0, 0, 0, 0.3, -0.8, 0.5]))
    values = np.linalg.eigvalsh(covariances(cloud).astype(np.float64))
    np.testing.assert_allclose(np.sqrt(values), np.sort(cloud.scales, axis=1), rtol=1e-2)


def test_texts_name_verdict_reason_and_figures():
    loop = LoopCandidate(
        "sessions/room/agents/agent_1/submaps/3", "sessions/room/agents/agent_0/submaps/1",
        0.71, "REJECTED", "FREE_SPACE", fitness=0.62, rmse_m=0.0123, inliers=87, overlap=0.4,
    )  # fmt: skip
    assert loop_title(loop) == "agent_1/3 - agent_0/1: REJECTED, FREE_SPACE"
    text = loop_text(loop)
    for part in ("REJECTED", "FREE_SPACE", "0.71", "0.62", "12.3 mm", "87 inliers"):
        assert part in text
    view = viewed_session((0, 1))
    view.loops = (loop,)
    now = datetime(2026, 1, 1, tzinfo=UTC)
    view.agents = (
        AgentInfo("sessions/room/agents/agent_0", "ACTIVE", now, now - timedelta(seconds=7), 2, 2),
    )
    later = agents_text(view, now=now + timedelta(hours=2))
    assert "| agent_0 | active | 2 h ago | 2 | 8 | joined |" in later
    assert "revision 3" in summary_text(view, 500)
    assert "1 rejected" in summary_text(view, 500)
    assert "| agent_0 | active | 7 s ago | 2 |" in agents_text(view, now=now)


def test_exported_trajectories_hold_every_frame():
    view = viewed_session((0, 1))
    with zipfile.ZipFile(io.BytesIO(trajectories_zip(view))) as archive:
        assert sorted(archive.namelist()) == ["agent_0.txt", "agent_1.txt"]
        lines = [
            line for line in archive.read("agent_1.txt").decode().splitlines()
            if not line.startswith("#")
        ]  # fmt: skip
    assert len(lines) == 8


def test_what_is_neither_run_nor_address_is_refused(tmp_path, capsys):
    assert run_command(["view", str(tmp_path)]) == 1
    assert "neither a run folder" in capsys.readouterr().err
