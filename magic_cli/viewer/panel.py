"""The side panel: layers, agents, loops, the chosen keyframe, and exports."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from magic_cli.viewer.model import SessionView
from magic_cli.viewer.scene import HIDDEN_AT_FIRST, LAYERS, Scene
from magic_core.evaluation.trajectory import Trajectory, write_tum
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.ply import write_ply
from magic_core.wire import names
from magic_core.wire.records import LoopCandidate

_NONE = "none"
_ALL = "free camera"
_IMAGE = np.full((48, 64, 3), 40, np.uint8)


class Panel:
    """The controls. `render` draws the map as a keyframe sees it (slow: it runs on request)."""

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        render: Callable[[str], NDArray[np.uint8]],
        export_map: Callable[[], GaussianCloud],
    ) -> None:
        self._server = server
        self._render = render
        self._export_map = export_map
        self._view: SessionView | None = None
        self._loops: dict[str, LoopCandidate] = {}
        self._boxes: dict[str, Any] = {}
        self.following: str | None = None
        """The agent whose camera the page follows."""

    def build(self, scene: Scene) -> None:
        """Make all controls; called once, when the scene exists."""
        gui = self._server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, control_width="medium")
        self._summary = gui.add_markdown("Waiting for the first sub-map.")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Map"):
            for layer in LAYERS:
                box = gui.add_checkbox(layer, layer not in HIDDEN_AT_FIRST)
                box.on_update(
                    lambda event, layer=layer: scene.show_layer(layer, event.target.value)
                )
            self._follow: Any = gui.add_dropdown("follow", (_ALL,))
            self._follow.on_update(self._on_follow)
        with tabs.add_tab("Agents"):
            self._agents = gui.add_markdown("No agent yet.")
            self._agent_boxes = gui.add_folder("show")
        with tabs.add_tab("Loops"):
            self._loop: Any = gui.add_dropdown("candidate", (_NONE,))
            self._loop.on_update(lambda event: self.choose_loop(event.target.value))
            self._loop_text = gui.add_markdown("Choose a candidate, or click a mark in the map.")
            self._loop_images = [gui.add_image(_IMAGE, label=t) for t in ("source", "target")]
        with tabs.add_tab("Keyframe"):
            self._anchor: Any = gui.add_dropdown("sub-map", (_NONE,))
            self._anchor.on_update(lambda event: self.choose_anchor(event.target.value))
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
        for agent in agents:
            if agent not in self._boxes:
                with self._agent_boxes:
                    box = self._boxes[agent] = self._server.gui.add_checkbox(agent, True)
                box.on_update(
                    lambda event, agent=agent: self._scene.show_agent(agent, event.target.value)
                )

    def choose_loop(self, title: str) -> None:
        """Show a candidate's verdict, figures and both images."""
        loop = self._loops.get(title)
        if loop is None or self._view is None:
            return
        self._loop_text.content = loop_text(loop)
        for box, name in zip(self._loop_images, (loop.source, loop.target), strict=True):
            box.image = self._view.submaps[name].keyframes[0].colour

    def select_loop(self, loop: LoopCandidate) -> None:
        """As if it had been chosen in the list."""
        self._loop.value = loop_title(loop)

    def choose_anchor(self, title: str) -> None:
        """Show an anchor image beside the map rendered from its pose."""
        if self._view is None or title == _NONE:
            return
        name = next((n for n in self._view.submaps if short(n) == title), None)
        if name is not None:
            self._real.image = self._view.submaps[name].keyframes[0].colour
            self._rendered.image = self._render(name)

    def select_anchor(self, name: str) -> None:
        """As if it had been chosen in the list."""
        self._anchor.value = short(name)

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


def summary_text(view: SessionView, shown: int) -> str:
    """One paragraph: revision, counts, and how much of the map the browser has."""
    snapshot = view.snapshot
    if snapshot is None or not view.submaps:
        return f"**{view.session}**: waiting for the first sub-map."
    what = "merged map" if view.merged else "sub-maps"
    verdicts = [loop.verdict for loop in view.loops]
    lines = [
        f"**{view.session}**, pose graph revision {snapshot.revision}",
        f"{len(view.submaps)} sub-maps in {len(snapshot.components)} component(s)",
        f"showing the {what}, {shown:,} Gaussians",
        f"loops: {verdicts.count('ACCEPTED')} accepted ({snapshot.loops_kept} relied on), "
        f"{verdicts.count('REJECTED')} rejected, {verdicts.count('PENDING')} under verification",
    ]
    return "  \n".join(lines)


def agents_text(view: SessionView, *, now: datetime | None = None) -> str:
    """A table: state, when last heard of, sub-maps."""
    if not view.agents:
        return "No agent yet."
    now = now or datetime.now(UTC)
    rows = [
        f"| {names.parse_agent(agent.name)[1]} | {agent.state.lower()} | "
        f"{max(0, round((now - agent.last_seen_at).total_seconds()))} s ago | "
        f"{agent.submap_count} |"
        for agent in view.agents
    ]
    return "\n".join(["| agent | state | heard of | sub-maps |", "|---|---|---|---|", *rows])


def loop_title(loop: LoopCandidate) -> str:
    """`agent_0/1 - agent_2/3: REJECTED, FREE_SPACE`."""
    end = "" if loop.verdict == "ACCEPTED" else f", {loop.reason}"
    return f"{short(loop.source)} - {short(loop.target)}: {loop.verdict}{end}"


def loop_text(loop: LoopCandidate) -> str:
    """A candidate's verdict and figures."""
    used = " and relied on" if loop.kept else ""
    return "  \n".join(
        [
            f"**{loop.verdict}{used}**: `{loop.reason}`",
            f"similarity {loop.similarity:.2f}, overlap {loop.overlap:.2f}",
            f"fitness {loop.fitness:.2f}, RMSE {1e3 * loop.rmse_m:.1f} mm, {loop.inliers} inliers",
            f"verified in {loop.verify_seconds:.2f} s",
        ]
    )


def short(name: str) -> str:
    """`agent/3` of a sub-map's resource name."""
    _, agent, index = names.parse_submap(name)
    return f"{agent}/{index}"


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
