"""The page: a viser server, the scene, the panel, and the map rendered on request."""

from __future__ import annotations

import contextlib
import io
import threading
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from magic_cli.viewer.model import Pose, SessionView
from magic_cli.viewer.panel import Panel
from magic_cli.viewer.scene import Scene
from magic_cli.viewer.vantage import FIELD_OF_VIEW_RAD, Vector, outside
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3


class Page:
    """What a browser sees; `update` is called with each new state, from one thread at a time."""

    def __init__(self, *, host: str, port: int, max_splats: int) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # its banner; ours comes from the command
            self._server = viser.ViserServer(
                host=host, port=port, label="magic-slam", verbose=False
            )
        self._lock = threading.Lock()
        self._render_lock = threading.Lock()
        self._view: SessionView | None = None
        self._rasteriser: Any = None
        self._placed_for = (0, 0)
        """How many sub-maps and components there were when the view of the whole was chosen."""
        self._whole_from: Vector | None = None
        """Where that view stands: a visitor who is there has not moved, and goes on seeing all."""
        self._server.initial_camera.fov = FIELD_OF_VIEW_RAD
        self._panel = Panel(
            self._server,
            render=self._rendered,
            export_map=self._whole_map,
            see_everything=self._see_everything,
        )
        self._scene = Scene(
            self._server,
            max_splats=max_splats,
            on_keyframe=self._panel.select_keyframe,
            on_loop=self._panel.select_loop,
        )
        self._panel.build(self._scene)

    @property
    def address(self) -> str:
        """The page's URL."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def update(self, view: SessionView) -> None:
        """Show the newest state."""
        with self._lock:
            self._view = view
            self._scene.update(view)
            self._panel.update(view)
            size = len(view.submaps), len(view.snapshot.components) if view.snapshot else 0
            if size != self._placed_for:
                self._place_cameras(view)
                self._placed_for = size
            self._follow(view)

    def close(self) -> None:
        """Stop serving the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _place_cameras(self, view: SessionView) -> None:
        """New visitors see the whole map; so do those who have not moved since they saw it."""
        anchors = view.world_from_anchor()
        if not anchors:
            return
        position, look_at = outside(view, anchors, self._scene.up)
        unmoved = [
            client
            for client in self._server.get_clients().values()
            if _is_at(client.camera, self._whole_from)
        ]
        for camera in (self._server.initial_camera, *(client.camera for client in unmoved)):
            camera.position, camera.look_at = position, look_at
        self._whole_from = position

    def _see_everything(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if self._view is None or not self._view.world_from_anchor():
                return
            self._place_cameras(self._view)
            whole, up = self._server.initial_camera, self._scene.up
        with client.atomic():
            client.camera.up_direction = tuple(up)
            client.camera.position, client.camera.look_at = whole.position, whole.look_at

    def _follow(self, view: SessionView) -> None:
        """Put every visitor's camera behind the followed agent's newest frame."""
        agent = self._panel.following
        parts = view.world_from_cameras(agent, view.world_from_anchor()) if agent else []
        if not parts:
            return
        pose = parts[-1][-1]
        behind = pose[:3, 3] - 0.8 * pose[:3, 2] - 0.3 * pose[:3, 1]
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = tuple(behind)
                client.camera.look_at = tuple(pose[:3, 3] + pose[:3, 2])

    def _whole_map(self) -> GaussianCloud:
        """The merged maps, or else all sub-maps at their corrected poses; the largest component."""
        with self._lock:
            view = self._view
            if view is None or view.snapshot is None or not view.snapshot.components:
                return GaussianCloud.empty()
            parts = _parts_of(view, view.snapshot.components[0].id)
        return _joined(parts)

    def _rendered(self, name: str, keyframe: int) -> NDArray[np.uint8]:
        """The map from the pose of a sub-map's keyframe, (h, w, 3)."""
        from magic_core.render import Rasteriser

        with self._lock:
            assert self._view is not None
            assert self._view.snapshot is not None
            camera = self._view.submaps[name].camera
            parts = _parts_of(self._view, self._view.snapshot.poses[name].component)
            at = self._view.world_from_keyframe(name, keyframe)
        with self._render_lock:  # a large map takes a second: the page is kept up to date meanwhile
            self._rasteriser = self._rasteriser or Rasteriser()
            view = self._rasteriser.render(_joined(parts), camera, at)
        return (np.clip(view.colour, 0.0, 1.0) * 255).astype(np.uint8)


def _is_at(camera: viser.CameraHandle, place: Vector | None) -> bool:
    """Whether a visitor's camera stands at a place; so do all while there is no place yet."""
    if place is None:
        return True
    reach = np.linalg.norm(np.asarray(camera.look_at) - camera.position)
    return bool(np.linalg.norm(np.asarray(camera.position) - place) < 0.01 * reach)


def _parts_of(view: SessionView, component: str) -> list[tuple[GaussianCloud, Pose]]:
    """What a component's map consists of, each with its pose in the component's world frame."""
    if component in view.merged:
        return [(view.merged[component], se3.identity())]
    assert view.snapshot is not None
    return [
        (view.submaps[name].cloud, pose.world_from_anchor)
        for name, pose in view.snapshot.poses.items()
        if pose.component == component and name in view.submaps
    ]


def _joined(parts: list[tuple[GaussianCloud, Pose]]) -> GaussianCloud:
    return GaussianCloud.concatenate(
        [cloud.transformed(se3.orthonormalised(pose)) for cloud, pose in parts]
    )
