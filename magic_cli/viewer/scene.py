"""Drawing a session with viser: splats, paths, anchors and loops, each layer on its own.

A sub-map's Gaussians go to the browser once, in the anchor frame. A correction of the pose graph
then moves one transform per sub-map, as everywhere in this system.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from magic_cli.viewer.colours import colour_of
from magic_cli.viewer.detail import covariances, keep_every, thinned
from magic_cli.viewer.lines import LineLayer, Lines
from magic_cli.viewer.model import Pose, SessionView, SubmapView
from magic_cli.viewer.vantage import Vector, above, up_of
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.wire.records import LoopCandidate

Layer = Literal["splats", "ceiling", "anchors", "keyframes"] | LineLayer
LAYERS: tuple[Layer, ...] = (
    "splats", "ceiling", "paths", "names", "tracked paths", "anchors", "keyframes",
    "accepted loops", "rejected loops",
)  # fmt: skip
HIDDEN_AT_FIRST: frozenset[Layer] = frozenset({"ceiling", "tracked paths", "keyframes"})

_THUMBNAIL_STEP = 4
_ANCHOR_M = 0.12
_KEYFRAME_M = 0.07
_PYRAMID_FACES = np.array(
    [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]], np.uint32
)


class Scene:
    """The 3D part of the page."""

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        max_splats: int,
        on_keyframe: Callable[[str, int], None],
        on_loop: Callable[[LoopCandidate], None],
    ) -> None:
        """`on_keyframe` is called with a sub-map's name and the number of its keyframe."""
        self._server = server
        self._max_splats = max_splats
        self._on_keyframe = on_keyframe
        self._lines = Lines(server, on_loop)
        self._layers: dict[Layer, bool] = {layer: layer not in HIDDEN_AT_FIRST for layer in LAYERS}
        self._hidden_agents: set[str] = set()
        self._splats: dict[str, Any] = {}
        self._anchors: dict[str, Any] = {}
        self._keyframes: dict[str, Any] = {}
        self._merged: dict[str, Any] = {}
        self._keep_every = 1
        self._with_ceiling = False
        self._up: Vector | None = None
        self._replaced: frozenset[str] = frozenset()
        """Sub-maps whose component is shown as a merged map."""
        server.scene.set_background_image(np.full((2, 2, 3), (22, 26, 34), np.uint8))

    @property
    def up(self) -> Vector:
        """Unit (3,) up of the picture; y against gravity as cameras have it until one was seen."""
        return np.array([0.0, -1.0, 0.0]) if self._up is None else self._up

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

    def choose_loop(self, loop: LoopCandidate | None) -> None:
        """Highlight a loop; None takes the highlight away."""
        self._lines.choose(loop)

    def update(self, view: SessionView) -> None:
        """Bring the picture to the newest state: adds what is new, moves what is there."""
        anchors = view.world_from_anchor()
        if self._up is None and anchors:
            self._up = up_of(view, anchors)
            self._server.scene.set_up_direction(tuple(self._up))
        with self._server.atomic():
            self._send_again(view, anchors)
            for name, pose in anchors.items():
                self._place(view.submaps[name], pose)
            for name in self._splats.keys() - anchors.keys():
                for handles in (self._splats, self._anchors, self._keyframes):
                    if name in handles:
                        handles.pop(name).remove()
            self._draw_merged(view)
            self._lines.update(view, anchors)
        self._refresh_visibility()

    def _send_again(self, view: SessionView, anchors: dict[str, Pose]) -> None:
        """Send all splats again when the limit is passed (each time half as many are left), or
        when the ceiling was switched on or off."""
        step = keep_every(sum(len(s.cloud) for s in view.submaps.values()), self._max_splats)
        ceiling = self._layers["ceiling"]
        if (step, ceiling) == (self._keep_every, self._with_ceiling):
            return
        if ceiling != self._with_ceiling:
            for _, handle in self._merged.values():
                handle.remove()
            self._merged.clear()
        self._keep_every, self._with_ceiling = step, ceiling
        for name, handle in self._splats.items():
            if name in anchors:
                cloud = self._shown_part(view.submaps[name], anchors[name])
                handle.set_gaussians(*_splats_of(cloud))

    def _shown_part(self, submap: SubmapView, pose: Pose) -> GaussianCloud:
        """What is sent of a sub-map."""
        cloud = thinned(submap.cloud, self._keep_every)
        if self._with_ceiling or self._up is None or len(cloud) == 0:
            return cloud
        hidden = above(cloud.means, submap.path[:, :3, 3], pose[:3, :3].T @ self._up)
        return cloud if hidden.all() else cloud.select(~hidden)

    def _shown_map(self, cloud: GaussianCloud, cameras: NDArray) -> GaussianCloud:
        """What is sent of a merged map, which was seen by cameras at (k, 3)."""
        kept = thinned(cloud, keep_every(len(cloud), self._max_splats))
        if self._with_ceiling or self._up is None or len(kept) == 0 or len(cameras) == 0:
            return kept
        hidden = above(kept.means, cameras, self._up)
        return kept if hidden.all() else kept.select(~hidden)

    def _place(self, submap: SubmapView, pose: Pose) -> None:
        if submap.name not in self._splats:
            self._add(submap, pose)
        position, wxyz = _position(pose), _wxyz(pose)
        for handles in (self._splats, self._anchors, self._keyframes):
            if submap.name in handles:
                handle = handles[submap.name]
                handle.position, handle.wxyz = position, wxyz

    def _add(self, submap: SubmapView, pose: Pose) -> None:
        node = f"{submap.agent}/{submap.index}"
        centers, matrices, rgbs, opacities = _splats_of(self._shown_part(submap, pose))
        self._splats[submap.name] = self._server.scene.add_gaussian_splats(
            f"/splats/{node}", centers, matrices, rgbs, opacities
        )
        self._add_anchor(submap, f"/anchors/{node}")
        if len(submap.keyframes) > 1:
            self._add_keyframes(submap, f"/keyframes/{node}")

    def _add_anchor(self, submap: SubmapView, node: str) -> None:
        camera = submap.camera
        handle = self._server.scene.add_camera_frustum(
            node,
            fov=2.0 * float(np.arctan2(camera.height / 2, camera.fy)),
            aspect=camera.width / camera.height,
            scale=_ANCHOR_M,
            thickness=2.0,
            thickness_units="screen",
            color=colour_of(submap.agent),
            image=submap.keyframes[0].colour[::_THUMBNAIL_STEP, ::_THUMBNAIL_STEP],
            format="jpeg",
        )
        handle.on_click(lambda _event, name=submap.name: self._on_keyframe(name, 0))
        self._anchors[submap.name] = handle

    def _add_keyframes(self, submap: SubmapView, node: str) -> None:
        """A small pyramid for each keyframe but the anchor, in the anchor frame."""
        poses = np.stack([keyframe.anchor_from_camera for keyframe in submap.keyframes[1:]])
        handle = self._server.scene.add_batched_meshes_simple(
            node,
            _pyramid(submap.camera),
            _PYRAMID_FACES,
            batched_wxyzs=np.stack([_wxyz(pose) for pose in poses]),
            batched_positions=np.asarray(poses[:, :3, 3], np.float32),
            batched_colors=np.tile(np.array(colour_of(submap.agent), np.uint8), (len(poses), 1)),
            wireframe=True,
            visible=self._layers["keyframes"],
        )
        handle.on_click(
            lambda event, name=submap.name: self._on_keyframe(name, 1 + (event.instance_index or 0))
        )
        self._keyframes[submap.name] = handle

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
                kept = self._shown_map(cloud, view.camera_positions(component))
                handle = self._server.scene.add_gaussian_splats(
                    f"/merged/{number}", *_splats_of(kept)
                )
                known = self._merged[component] = (cloud, handle)
            known[1].position, known[1].wxyz = _position(offset), _wxyz(offset)
        shown = view.snapshot.poses if view.snapshot else {}
        self._replaced = frozenset(
            name for name, pose in shown.items() if pose.component in view.merged
        )

    def _refresh_visibility(self) -> None:
        for name, handle in self._splats.items():
            shown = self._layers["splats"] and name not in self._replaced
            handle.visible = shown and _agent_of(name) not in self._hidden_agents
        for _, handle in self._merged.values():
            handle.visible = self._layers["splats"]
        cameras: dict[Layer, dict[str, Any]] = {
            "anchors": self._anchors,
            "keyframes": self._keyframes,
        }
        for layer, handles in cameras.items():
            for name, handle in handles.items():
                handle.visible = self._layers[layer] and _agent_of(name) not in self._hidden_agents
        self._lines.show(self._layers, self._hidden_agents)


def _splats_of(cloud: GaussianCloud) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """(centers, covariances, rgbs, opacities) as viser wants them."""
    return (
        cloud.means,
        covariances(cloud),
        np.clip(cloud.colours, 0.0, 1.0),
        cloud.opacities[:, None],
    )


def _pyramid(camera: Camera) -> NDArray[np.float32]:
    """(5, 3): a camera's centre and the corners of its image, z forward."""
    x, y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
    corners = [[0, 0, 0], [-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]
    return np.array(corners, np.float32) * _KEYFRAME_M


def _position(pose: Pose) -> tuple[float, float, float]:
    x, y, z = pose[:3, 3]
    return float(x), float(y), float(z)


def _wxyz(pose: Pose) -> NDArray[np.float64]:
    return se3.quaternion_from_rotation(pose[:3, :3])


def _agent_of(name: str) -> str:
    return name.split("/")[3]
