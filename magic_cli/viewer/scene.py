"""Drawing a session with viser: splats, paths, anchors and loops, each layer on its own.

A sub-map's Gaussians go to the browser once, in the anchor frame. A correction of the pose graph
then moves one transform per sub-map, as everywhere in this system.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from magic_cli.viewer.detail import covariances, keep_every, thinned
from magic_cli.viewer.model import Pose, SessionView, SubmapView
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3
from magic_core.wire.records import LoopCandidate

Layer = Literal["splats", "paths", "tracked paths", "anchors", "accepted loops", "rejected loops"]
LAYERS: tuple[Layer, ...] = (
    "splats", "paths", "tracked paths", "anchors", "accepted loops", "rejected loops",
)  # fmt: skip
HIDDEN_AT_FIRST: frozenset[Layer] = frozenset({"tracked paths"})

GREEN, RED, ORANGE = (60, 200, 90), (230, 60, 60), (240, 160, 40)
_PALETTE = ((79, 156, 255), (255, 160, 60), (120, 210, 120), (230, 110, 200), (170, 140, 255),
            (250, 220, 90), (90, 210, 220), (240, 120, 110))  # fmt: skip
_THUMBNAIL_STEP = 4
_OCTAHEDRON = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32
)
_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    np.uint32,
)
_MARK_M = 0.05
_EVERY_MEAN = 16


class Scene:
    """The 3D part of the page."""

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        max_splats: int,
        on_anchor: Callable[[str], None],
        on_loop: Callable[[LoopCandidate], None],
    ) -> None:
        self._server = server
        self._max_splats = max_splats
        self._on_anchor = on_anchor
        self._on_loop = on_loop
        self._layers: dict[Layer, bool] = {layer: layer not in HIDDEN_AT_FIRST for layer in LAYERS}
        self._hidden_agents: set[str] = set()
        self._splats: dict[str, Any] = {}
        self._anchors: dict[str, Any] = {}
        self._lines: dict[tuple[Layer, str], Any] = {}
        self._merged: dict[str, Any] = {}
        self._keep_every = 1
        self._replaced: frozenset[str] = frozenset()
        """Sub-maps whose component is shown as a merged map."""
        self._loops_drawn = b""
        server.scene.set_up_direction("-y")  # the world is the first camera's frame: y is down
        server.scene.set_background_image(np.full((2, 2, 3), (22, 26, 34), np.uint8))

    @property
    def shown_splats(self) -> int:
        """Gaussians in the browser that are not hidden by a merged map."""
        of_submaps = sum(
            len(handle.opacities)
            for name, handle in self._splats.items()
            if name not in self._replaced
        )
        return of_submaps + sum(len(handle.opacities) for _, handle in self._merged.values())

    def show_layer(self, layer: Layer, visible: bool) -> None:
        """Switch a layer on or off."""
        self._layers[layer] = visible
        self._refresh_visibility()

    def show_agent(self, agent: str, visible: bool) -> None:
        """Show or hide all that one agent sent."""
        (self._hidden_agents.discard if visible else self._hidden_agents.add)(agent)
        self._refresh_visibility()

    def update(self, view: SessionView) -> None:
        """Bring the picture to the newest state: adds what is new, moves what is there."""
        anchors = view.world_from_anchor()
        with self._server.atomic():
            self._thin(view)
            for name, pose in anchors.items():
                self._place(view.submaps[name], pose)
            for name in self._splats.keys() - anchors.keys():
                self._splats.pop(name).remove()
                self._anchors.pop(name).remove()
            self._draw_merged(view)
            self._draw_paths(view, anchors)
            self._draw_loops(view, anchors)
        self._refresh_visibility()

    def look_from_outside(self, view: SessionView) -> None:
        """Point the cameras of new visitors at the whole map, from behind and above the agents."""
        anchors = view.world_from_anchor()
        if not anchors:
            return
        means = np.concatenate(
            [
                se3.transform_points(pose, view.submaps[name].cloud.means[::_EVERY_MEAN])
                for name, pose in anchors.items()
            ]
        )
        centre = np.median(means, axis=0)
        reach = max(1.0, float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.9)))
        ahead = np.stack([pose[:3, 2] for pose in anchors.values()]).mean(axis=0)
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        # The panel covers the right of the page, so the map is put to the left of its middle.
        target = centre + 0.45 * reach * right
        camera = self._server.initial_camera
        camera.position = tuple(target - 1.9 * reach * ahead + [0.0, -1.1 * reach, 0.0])
        camera.look_at = tuple(target)

    def _thin(self, view: SessionView) -> None:
        """Send all splats again, thinner, when the limit is passed (each time half as many)."""
        step = keep_every(sum(len(s.cloud) for s in view.submaps.values()), self._max_splats)
        if step == self._keep_every:
            return
        self._keep_every = step
        for name, handle in self._splats.items():
            handle.set_gaussians(*_splats_of(thinned(view.submaps[name].cloud, step)))

    def _place(self, submap: SubmapView, pose: Pose) -> None:
        if submap.name not in self._splats:
            self._add(submap)
        position, wxyz = _position(pose), _wxyz(pose)
        for handle in (self._splats[submap.name], self._anchors[submap.name]):
            handle.position, handle.wxyz = position, wxyz

    def _add(self, submap: SubmapView) -> None:
        node = f"{submap.agent}/{submap.index}"
        cloud = thinned(submap.cloud, self._keep_every)
        centers, matrices, rgbs, opacities = _splats_of(cloud)
        self._splats[submap.name] = self._server.scene.add_gaussian_splats(
            f"/splats/{node}", centers, matrices, rgbs, opacities
        )
        camera = submap.camera
        handle = self._server.scene.add_camera_frustum(
            f"/anchors/{node}",
            fov=2.0 * float(np.arctan2(camera.height / 2, camera.fy)),
            aspect=camera.width / camera.height,
            scale=0.12,
            thickness=2.0,
            thickness_units="screen",
            color=colour_of(submap.agent),
            image=submap.keyframes[0].colour[::_THUMBNAIL_STEP, ::_THUMBNAIL_STEP],
            format="jpeg",
        )
        handle.on_click(lambda _event, name=submap.name: self._on_anchor(name))
        self._anchors[submap.name] = handle

    def _draw_merged(self, view: SessionView) -> None:
        """The merged maps stand in for the sub-maps of their component."""
        for component in self._merged.keys() - view.merged.keys():
            self._merged.pop(component)[1].remove()
        for number, (component, cloud) in enumerate(view.merged.items()):
            offset = view.component_offset(component)
            known = self._merged.get(component)
            if known is None or known[0] is not cloud:
                if known is not None:
                    known[1].remove()
                kept = thinned(cloud, keep_every(len(cloud), self._max_splats))
                handle = self._server.scene.add_gaussian_splats(
                    f"/merged/{number}", *_splats_of(kept)
                )
                known = self._merged[component] = (cloud, handle)
            known[1].position, known[1].wxyz = _position(offset), _wxyz(offset)
        shown = view.snapshot.poses if view.snapshot else {}
        self._replaced = frozenset(
            name for name, pose in shown.items() if pose.component in view.merged
        )

    def _draw_paths(self, view: SessionView, anchors: dict[str, Pose]) -> None:
        tracked = view.tracked()
        for agent in view.agent_names():
            colour = np.array(colour_of(agent))
            self._draw_path("paths", agent, view.world_from_cameras(agent, anchors), colour)
            before = view.world_from_cameras(agent, tracked)
            self._draw_path("tracked paths", agent, before, colour // 2)

    def _draw_path(self, layer: Layer, agent: str, parts: list[NDArray], colour: NDArray) -> None:
        segments = _segments([part[:, :3, 3] for part in parts])
        self._draw_lines((layer, agent), segments, colour)

    def _draw_loops(self, view: SessionView, anchors: dict[str, Pose]) -> None:
        loops = [c for c in view.loops if c.source in anchors and c.target in anchors]
        ends = {
            id(c): np.stack([anchors[c.source][:3, 3], anchors[c.target][:3, 3]]) for c in loops
        }
        drawn = hashlib.sha256(
            b"".join(ends[id(c)].tobytes() + c.verdict.encode() + bytes([c.kept]) for c in loops)
        ).digest()
        if drawn == self._loops_drawn:
            return
        self._loops_drawn = drawn
        layers: dict[Layer, str] = {"accepted loops": "ACCEPTED", "rejected loops": "REJECTED"}
        for layer, verdict in layers.items():
            some = [c for c in loops if c.verdict == verdict]
            colours = np.array([loop_colour(c) for c in some], np.uint8).reshape(-1, 3)
            points = np.array([ends[id(c)] for c in some], np.float32).reshape(-1, 2, 3)
            self._draw_lines((layer, "lines"), points, np.repeat(colours[:, None], 2, axis=1))
            self._draw_marks(layer, some, points.mean(axis=1), colours)

    def _draw_marks(
        self,
        layer: Layer,
        loops: list[LoopCandidate],
        places: NDArray[np.float32],
        colours: NDArray[np.uint8],
    ) -> None:
        """A small body half-way along each loop, which can be clicked."""
        key = (layer, "marks")
        if key in self._lines:
            self._lines.pop(key).remove()
        if not loops:
            return
        handle = self._server.scene.add_batched_meshes_simple(
            f"/loops/{layer.replace(' ', '_')}_marks",
            _MARK_M * _OCTAHEDRON,
            _FACES,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(loops), 1)),
            batched_positions=places,
            batched_colors=colours,
            flat_shading=True,
        )
        handle.on_click(lambda event: self._on_loop(loops[event.instance_index or 0]))
        self._lines[key] = handle

    def _draw_lines(self, key: tuple[Layer, str], points: NDArray, colours: NDArray) -> None:
        """Replace one set of line segments (n, 2, 3)."""
        if key in self._lines:
            self._lines.pop(key).remove()
        if len(points) == 0:
            return
        node = "/" + "/".join(part.replace(" ", "_") for part in key)
        self._lines[key] = self._server.scene.add_line_segments(
            node, np.asarray(points, np.float32), colours,
            thickness=2.5, thickness_units="screen",
        )  # fmt: skip

    def _refresh_visibility(self) -> None:
        for name, handle in self._splats.items():
            shown = self._layers["splats"] and name not in self._replaced
            handle.visible = shown and _agent_of(name) not in self._hidden_agents
        for _, handle in self._merged.values():
            handle.visible = self._layers["splats"]
        for name, handle in self._anchors.items():
            handle.visible = self._layers["anchors"] and _agent_of(name) not in self._hidden_agents
        for (layer, agent), handle in self._lines.items():
            handle.visible = self._layers[layer] and agent not in self._hidden_agents


def colour_of(agent: str) -> tuple[int, int, int]:
    """An agent's colour, the same in every session: by the number that ends its name, or a hash."""
    digits = agent[len(agent.rstrip("0123456789")) :]
    number = int(digits[-6:]) if digits else hashlib.sha256(agent.encode()).digest()[0]
    return _PALETTE[number % len(_PALETTE)]


def loop_colour(loop: LoopCandidate) -> tuple[int, int, int]:
    """Green: relied on. Orange: accepted, but unused by the newest solution. Red: rejected."""
    if loop.verdict == "ACCEPTED":
        return GREEN if loop.kept else ORANGE
    return RED


def _splats_of(cloud: GaussianCloud) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """(centers, covariances, rgbs, opacities) as viser wants them."""
    return (
        cloud.means,
        covariances(cloud),
        np.clip(cloud.colours, 0.0, 1.0),
        cloud.opacities[:, None],
    )


def _segments(paths: list[NDArray]) -> NDArray:
    """(n, 2, 3): the steps of each path, and those from one to the next."""
    if not paths:
        return np.zeros((0, 2, 3), np.float32)
    points = np.concatenate(paths)
    return np.stack([points[:-1], points[1:]], axis=1)


def _position(pose: Pose) -> tuple[float, float, float]:
    x, y, z = pose[:3, 3]
    return float(x), float(y), float(z)


def _wxyz(pose: Pose) -> NDArray[np.float64]:
    return se3.quaternion_from_rotation(pose[:3, :3])


def _agent_of(name: str) -> str:
    return name.split("/")[3]
