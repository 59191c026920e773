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

from magic_cli.loops import EXPLANATIONS, NO_CANDIDATES
from magic_cli.viewer.colours import loop_colour
from magic_cli.viewer.model import SessionView
from magic_cli.viewer.scene import HIDDEN_AT_FIRST, LAYERS, Scene
from magic_core.evaluation.trajectory import Trajectory, write_tum
from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.ply import write_ply
from magic_core.submap import Keyframe
from magic_core.wire import names
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
    ) -> None:
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
_BLUE = (79, 156, 255)


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
    """A table: state, when last heard of, what it sent, and whom it shares a map with."""
    if not view.agents:
        return "No agent yet."
    now = now or datetime.now(UTC)
    rows = [
        f"| {names.parse_agent(agent.name)[1]} | {agent.state.lower()} | "
        f"{max(0, round((now - agent.last_seen_at).total_seconds()))} s ago | "
        f"{agent.submap_count} | {_frames(view, agent.name)} | {_map_of(view, agent.name)} |"
        for agent in view.agents
    ]
    head = ["| agent | state | heard of | sub-maps | frames | map |", "|---|---|---|---|---|---|"]
    return "\n".join([*head, *rows])


def _frames(view: SessionView, agent: str) -> int:
    """Frames in the sub-maps that an agent sent."""
    return sum(len(s.path) for n, s in view.submaps.items() if n.startswith(f"{agent}/"))


def _map_of(view: SessionView, agent: str) -> str:
    """Whether an agent's sub-maps lie in one map with those of others."""
    if view.snapshot is None or _frames(view, agent) == 0:
        return ""
    joined = any(agent in c.agents and len(c.agents) > 1 for c in view.snapshot.components)
    return "joined" if joined else "alone"


def loop_title(loop: LoopCandidate) -> str:
    """`agent_0/1 - agent_2/3: REJECTED, FREE_SPACE`."""
    end = "" if loop.verdict == "ACCEPTED" else f", {loop.reason}"
    return f"{short(loop.source)} - {short(loop.target)}: {loop.verdict}{end}"


def loop_text(loop: LoopCandidate, *, plain: bool = False) -> str:
    """A candidate's verdict and figures, as Markdown or plain text."""
    used = " and relied on" if loop.kept else ""
    set_aside = loop.verdict == "ACCEPTED" and not loop.kept
    reason = "SET_ASIDE_BY_SOLVER" if set_aside else loop.reason
    lines = [
        f"similarity {loop.similarity:.2f}, overlap {loop.overlap:.2f}",
        f"fitness {loop.fitness:.2f}, RMSE {1e3 * loop.rmse_m:.1f} mm, {loop.inliers} inliers",
        f"verified in {loop.verify_seconds:.2f} s",
    ]
    if plain:
        return ", ".join(lines)
    head = [f"**{loop.verdict}{used}**: `{reason}`", EXPLANATIONS.get(reason, "")]
    return "  \n".join([line for line in (*head, *lines) if line])


def keyframe_text(agent: str, keyframe: Keyframe, rendered: NDArray[np.uint8]) -> str:
    """Which frame it is, and how well the map shows it."""
    error = np.square(keyframe.colour.astype(np.float64) - rendered).mean()
    psnr_db = 10.0 * np.log10(255.0**2 / max(float(error), 1e-6))
    return (
        f"Frame {keyframe.frame_index} of {agent}, {keyframe.timestamp_s:.2f} s  \n"
        f"rendered against real: PSNR {psnr_db:.1f} dB"
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


def _number(title: str) -> int:
    """The keyframe that an entry of the list names."""
    return int(title.split()[0])
