"""The side panel: layers, agents, loops, the chosen keyframe, and exports."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from magic_cli.loops import NO_CANDIDATES
from magic_cli.viewer.colours import loop_colour
from magic_cli.viewer.model import SessionView
from magic_cli.viewer.scene import HIDDEN_AT_FIRST, LAYERS, Scene
from magic_cli.viewer.words import (
    agents_text,
    keyframe_text,
    loop_text,
    loop_title,
    short,
    summary_text,
)
from magic_core.evaluation.trajectory import Trajectory, write_tum
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.ply import write_ply
from magic_core.wire.records import LoopCandidate

_NONE = "none"
_ALL = "free camera"
_ANCHOR = "0 (anchor)"
_IMAGE = np.full((48, 64, 3), 40, np.uint8)


class Panel:
    """The controls. `render` draws the map as a keyframe sees it (slow: it runs on request)."""

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        render: Callable[[str, int], NDArray[np.uint8]],
        export_map: Callable[[], GaussianCloud],
        see_everything: Callable[[viser.ClientHandle], None],
    ) -> None:
        self._see_everything = see_everything
        self._server = server
        self._render = render
        self._export_map = export_map
        self._view: SessionView | None = None
        self._loops: dict[str, LoopCandidate] = {}
        self._boxes: dict[str, Any] = {}
        self._keyframe: tuple[str, int] | None = None
        self.following: str | None = None
        """The agent whose camera the page follows."""

    def build(self, scene: Scene) -> None:
        """Make all controls; called once, when the scene exists."""
        gui = self._server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, control_width="large")
        self._summary = gui.add_markdown("Waiting for the first sub-map.")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Map"):
            for layer in LAYERS:
                box = gui.add_checkbox(layer, layer not in HIDDEN_AT_FIRST)
                box.on_update(
                    lambda event, layer=layer: scene.show_layer(layer, event.target.value)
                )
            gui.add_button("see everything").on_click(
                lambda event: event.client and self._see_everything(event.client)
            )
            self._follow: Any = gui.add_dropdown("follow", (_ALL,))
            self._follow.on_update(self._on_follow)
        with tabs.add_tab("Agents"):
            self._agents = gui.add_markdown("No agent yet.")
            self._agent_boxes = gui.add_folder("show")
        with tabs.add_tab("Loops"):
            self._loop: Any = gui.add_dropdown("candidate", (_NONE,))
            self._loop.on_update(lambda event: self.choose_loop(event.target.value))
            gui.add_button("look at it").on_click(self._look_at_loop)
            self._loop_text = gui.add_markdown(_CHOOSE_LOOP)
            self._loop_images = [gui.add_image(_IMAGE, label=t) for t in ("source", "target")]
        with tabs.add_tab("Keyframe"):
            self._anchor: Any = gui.add_dropdown("sub-map", (_NONE,))
            self._anchor.on_update(lambda _: self._choose_keyframe(self._anchor.value, 0))
            self._number: Any = gui.add_dropdown("keyframe", (_ANCHOR,))
            self._number.on_update(
                lambda _: self._choose_keyframe(self._anchor.value, _number(self._number.value))
            )
            self._keyframe_text = gui.add_markdown("Choose a sub-map, or click a camera.")
            self._real = gui.add_image(_IMAGE, label="camera image")
            self._rendered = gui.add_image(_IMAGE, label="rendered from the map")
        with tabs.add_tab("Export"):
            gui.add_button("map as 3DGS PLY").on_click(self._send_map)
            gui.add_button("trajectories (TUM)").on_click(self._send_trajectories)
        self._scene = scene

    def update(self, view: SessionView) -> None:
        """Show the newest figures."""
        self._view = view
        self._summary.content = summary_text(view, self._scene.shown_splats)
        self._agents.content = agents_text(view)
        agents = view.agent_names()
        self._options(self._follow, (_ALL, *agents))
        self._options(self._anchor, (_NONE, *(short(name) for name in view.submaps)))
        self._loops = {loop_title(c): c for c in view.loops if c.verdict in _SHOWN}
        self._options(self._loop, (_NONE, *self._loops))
        if self._loop.value == _NONE:
            self._loop_text.content = _CHOOSE_LOOP if view.loops else NO_CANDIDATES
        for agent in agents:
            if agent not in self._boxes:
                with self._agent_boxes:
                    box = self._boxes[agent] = self._server.gui.add_checkbox(agent, True)
                box.on_update(
                    lambda event, agent=agent: self._scene.show_agent(agent, event.target.value)
                )

    def choose_loop(self, title: str) -> None:
        """Show a candidate's verdict, figures and both images, and highlight it in the map."""
        loop = self._loops.get(title)
        self._scene.choose_loop(loop)
        if loop is None or self._view is None:
            self._loop_text.content = _CHOOSE_LOOP
            return
        self._loop_text.content = loop_text(loop)
        for box, name in zip(self._loop_images, (loop.source, loop.target), strict=True):
            box.image = self._view.submaps[name].keyframes[0].colour

    def select_loop(self, loop: LoopCandidate) -> None:
        """As if it had been chosen in the list; said beside the map too, whatever tab is open."""
        self._loop.value = loop_title(loop)
        self._say(f"Loop {loop_title(loop)}", loop_text(loop, plain=True), loop_colour(loop))

    def _look_at_loop(self, event: Any) -> None:
        """Move a visitor's camera so that both ends of the chosen loop are in the picture."""
        loop, view = self._loops.get(self._loop.value), self._view
        anchors = view.world_from_anchor() if view else {}
        if loop is None or not {loop.source, loop.target} <= anchors.keys():
            return
        ends = np.stack([anchors[name][:3, 3] for name in (loop.source, loop.target)])
        middle, camera = ends.mean(axis=0), event.client.camera
        away = np.asarray(camera.position) - np.asarray(camera.look_at)
        away = away / max(float(np.linalg.norm(away)), 1e-6)
        distance = max(_NEAREST_M, 1.5 * float(np.linalg.norm(ends[1] - ends[0])))
        with event.client.atomic():
            camera.position, camera.look_at = tuple(middle + distance * away), tuple(middle)

    def select_keyframe(self, name: str, number: int) -> None:
        """As if it had been chosen in the lists."""
        self._choose_keyframe(short(name), number)
        self._say(f"Keyframe {number} of {short(name)}", "The tab Keyframe shows it.", _BLUE)

    def _choose_keyframe(self, title: str, number: int) -> None:
        """Show a camera image beside the map rendered from its pose."""
        view = self._view
        name = next((n for n in view.submaps if short(n) == title), None) if view else None
        if view is None or name is None or self._keyframe == (name, number):
            return
        self._keyframe = name, number  # before the lists are set, which calls this again
        submap = view.submaps[name]
        numbers = (_ANCHOR, *map(str, range(1, len(submap.keyframes))))
        self._anchor.value = title
        self._options(self._number, numbers)
        self._number.value = numbers[number]
        keyframe = submap.keyframes[number]
        self._real.image = keyframe.colour
        self._keyframe_text.content = f"Frame {keyframe.frame_index} of {submap.agent}, rendering"
        rendered = self._render(name, number)
        self._rendered.image = rendered
        self._keyframe_text.content = keyframe_text(submap.agent, keyframe, rendered)

    def _say(self, title: str, body: str, colour: tuple[int, int, int]) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(title, body, auto_close_seconds=8.0, color=colour)

    def _on_follow(self, event: Any) -> None:
        self.following = None if event.target.value == _ALL else event.target.value

    @staticmethod
    def _options(dropdown: Any, options: tuple[str, ...]) -> None:
        """New options without losing the choice; nothing is sent when they are the same."""
        if tuple(dropdown.options) != options:
            chosen = dropdown.value
            dropdown.options = options
            if chosen in options:
                dropdown.value = chosen

    def _send_map(self, event: Any) -> None:
        event.client.send_file_download(
            "map.ply", ply_of(self._export_map()), save_immediately=True
        )

    def _send_trajectories(self, event: Any) -> None:
        if self._view is not None:
            event.client.send_file_download(
                "trajectories.zip", trajectories_zip(self._view), save_immediately=True
            )


_SHOWN = ("ACCEPTED", "REJECTED")
_CHOOSE_LOOP = "Choose a candidate, or click a mark in the map."
_NEAREST_M = 2.5
_BLUE = (79, 156, 255)


def trajectories_zip(view: SessionView) -> bytes:
    """One TUM file per agent with its corrected poses, zipped."""
    anchors = view.world_from_anchor()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, TemporaryDirectory() as at:
        for agent in view.agent_names():
            poses = [
                (time_s, anchors[submap.name] @ pose)
                for submap in view.submaps.values()
                if submap.agent == agent and submap.name in anchors
                for time_s, pose in zip(submap.times_s, submap.path, strict=True)
            ]
            path = write_tum(Path(at) / f"{agent}.txt", Trajectory.from_poses(poses))
            archive.write(path, path.name)
    return buffer.getvalue()


def ply_of(cloud: GaussianCloud) -> bytes:
    """A 3DGS PLY file."""
    with TemporaryDirectory() as at:
        return write_ply(Path(at) / "map.ply", cloud).read_bytes()


def _number(title: str) -> int:
    """The keyframe that an entry of the list names."""
    return int(title.split()[0])
