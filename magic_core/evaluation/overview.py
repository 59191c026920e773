"""The picture of a run: its map from a place where nobody stood, and where the agents went."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from matplotlib import colors, patheffects
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magic_core.evaluation import vantage
from magic_core.evaluation.charts import colour_of
from magic_core.evaluation.trajectory import Trajectory
from magic_core.evaluation.views import ComparedView, Renders, View
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3

_WIDTH, _HEIGHT = 1280, 860
_GROUND = np.array((18, 21, 27), np.float32)
_OBSERVERS = 36
_FRUSTUM_PX = 26  # depth of a drawn camera, as if seen from the side
_SUPERSAMPLING = 8  # cv2 draws with this many fractional positions per pixel


def overview_picture(
    cloud: GaussianCloud,
    camera: Camera,
    trajectories: Mapping[str, Trajectory],
    rasteriser: Renders,
    *,
    new_views: Sequence[ComparedView] = (),
) -> bytes:
    """PNG bytes: the map from outside with all trajectories, and beside it some new views."""
    outside = outside_picture(cloud, camera, trajectories, rasteriser)
    agents = sorted(trajectories)
    figure = Figure(figsize=(15.4, 7.6), facecolor=_hex(_GROUND))
    grid = figure.add_gridspec(
        3, 2, width_ratios=(3.05, 1), left=0.008, right=0.992, top=0.985, bottom=0.015,
        wspace=0.012, hspace=0.03,
    )  # fmt: skip
    axes = figure.add_subplot(grid[:, 0])
    axes.imshow(outside, interpolation="lanczos", aspect="auto")
    axes.set_axis_off()
    rim = [patheffects.withStroke(linewidth=4, foreground=_hex(_GROUND))]
    for number, agent in enumerate(agents):
        colour, height = colour_of(number, on_dark=True), 0.965 - 0.042 * number
        axes.text(0.018, height, agent, color=colour, fontsize=15, fontweight="bold",
                  transform=axes.transAxes, va="top", path_effects=rim)  # fmt: skip
    for row, view in enumerate(_one_per_agent(new_views)[:3]):
        _new_view(figure.add_subplot(grid[row, 1]), view, agents)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, facecolor=figure.get_facecolor())
    return buffer.getvalue()


def outside_picture(
    cloud: GaussianCloud,
    camera: Camera,
    trajectories: Mapping[str, Trajectory],
    rasteriser: Renders,
) -> NDArray[np.uint8]:
    """(h, w, 3) the map seen from above at an angle, walls between it and the viewer left out."""
    scene = scene_of(cloud, camera, trajectories, rasteriser)
    outside = vantage.outside_camera(_WIDTH, _HEIGHT)
    pose = vantage.best_outside_pose(scene, outside, rasteriser)
    picture = cut_open(scene, outside, pose, rasteriser)
    for number, agent in enumerate(sorted(trajectories)):
        _draw_track(picture, outside, pose, trajectories[agent], colour_of(number, on_dark=True))
    return picture


def scene_of(
    cloud: GaussianCloud,
    camera: Camera,
    trajectories: Mapping[str, Trajectory],
    rasteriser: Renders,
) -> vantage.Scene:
    """The map with what its cameras saw of it, ready to be looked at from outside."""
    frame = vantage.plan_frame(list(trajectories.values()))
    poses = np.concatenate([t.world_from_camera for t in trajectories.values()])
    watchers = poses[np.linspace(0, len(poses) - 1, min(_OBSERVERS, len(poses))).astype(int)]
    seen = vantage.seen_surface(cloud, camera, watchers, rasteriser)
    return vantage.Scene(cloud, seen, frame, poses[:, :3, 3])


def cut_open(
    scene: vantage.Scene, camera: Camera, pose: NDArray[np.float64], rasteriser: Renders
) -> NDArray[np.uint8]:
    """(h, w, 3) a scene from outside, on a dark ground, walls that face away left out."""
    shown = scene.cloud.select(vantage.facing(scene.cloud, scene.seen, pose[:3, 3]))
    return on_ground(rasteriser.render(shown, camera, pose))


def on_ground(view: View) -> NDArray[np.uint8]:
    """(h, w, 3) a rendered view on a dark ground."""
    image = 255.0 * view.colour + (1.0 - view.alpha[..., None]) * _GROUND
    return np.ascontiguousarray(np.clip(np.rint(image), 0, 255), np.uint8)


def _draw_track(
    picture: NDArray[np.uint8],
    camera: Camera,
    world_from_camera: NDArray[np.float64],
    trajectory: Trajectory,
    colour: str,
) -> None:
    """A line with a dark rim, and the frusta of some of the cameras."""
    camera_from_world = se3.inverse(world_from_camera)
    rgb = tuple(int(255 * c) for c in colors.to_rgb(colour))
    lines = [trajectory.positions]
    size_m = _FRUSTUM_PX / camera.fx * _distance(world_from_camera, trajectory)
    for pose in trajectory.world_from_camera[:: max(1, len(trajectory) // 8)]:
        lines += _frustum(pose, size_m=size_m)
    for width, tone in ((6, (12, 14, 18)), (3, rgb)):
        for number, line in enumerate(lines):
            pixels, z = camera.project(se3.transform_points(camera_from_world, line))
            if (z > 0.05).all():
                fixed = np.rint(pixels * _SUPERSAMPLING).astype(np.int32)
                thick = width if number == 0 else max(1, width - 2)
                cv2.polylines(picture, [fixed], False, tone, thick, cv2.LINE_AA, 3)


def _distance(world_from_camera: NDArray[np.float64], trajectory: Trajectory) -> float:
    """Metres from a viewer to the middle of a trajectory."""
    return float(np.linalg.norm(trajectory.positions.mean(axis=0) - world_from_camera[:3, 3]))


def _frustum(pose: NDArray[np.float64], *, size_m: float) -> list[NDArray[np.float64]]:
    corners = size_m * np.array(
        [(-0.6, -0.45, 1), (0.6, -0.45, 1), (0.6, 0.45, 1), (-0.6, 0.45, 1)]
    )
    world = se3.transform_points(pose, corners)
    centre = pose[:3, 3]
    return [world[[0, 1, 2, 3, 0]], *(np.stack([centre, corner]) for corner in world)]


def _one_per_agent(views: Sequence[ComparedView]) -> list[ComparedView]:
    """The first view of every agent, then the others."""
    first = {view.chosen.source.name: view for view in reversed(views)}
    leading = sorted(first.values(), key=lambda view: view.chosen.source.name)
    return leading + [view for view in views if view is not first[view.chosen.source.name]]


def _new_view(axes, view: ComparedView, agents: Sequence[str]) -> None:
    axes.imshow(view.colour, interpolation="lanczos", aspect="auto")
    axes.set_xticks([])
    axes.set_yticks([])
    number = agents.index(view.chosen.source.name) if view.chosen.source.name in agents else 0
    for spine in axes.spines.values():
        spine.set_color(colour_of(number, on_dark=True))
        spine.set_linewidth(2.5)
    label = f"new view, {view.psnr_db:.1f} dB"
    plate = {"facecolor": "black", "alpha": 0.55, "edgecolor": "none", "pad": 3}
    axes.text(0.03, 0.05, label, color="white", fontsize=10.5, transform=axes.transAxes, bbox=plate)


def _hex(rgb: NDArray) -> str:
    red, green, blue = (int(value) for value in rgb)
    return f"#{red:02x}{green:02x}{blue:02x}"
