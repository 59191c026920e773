"""The lines of the scene: trajectories with names, and loops, drawn anew when they changed."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from magic_cli.viewer.colours import colour_of, loop_colour, on_surface
from magic_cli.viewer.model import Pose, SessionView
from magic_core.wire.records import LoopCandidate

LineLayer = Literal["paths", "names", "tracked paths", "accepted loops", "rejected loops"]
_VERDICT: dict[LineLayer, str] = {"accepted loops": "ACCEPTED", "rejected loops": "REJECTED"}

_OCTAHEDRON = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32
)
_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    np.uint32,
)
_MARK_M = 0.05
_CHOSEN_M = 0.09
_WHITE = (255, 255, 255)


class Lines:
    """Trajectories, loops with a mark to click on each, and the chosen loop, highlighted."""

    def __init__(self, server: viser.ViserServer, on_loop: Callable[[LoopCandidate], None]) -> None:
        self._server = server
        self._on_loop = on_loop
        self._handles: dict[tuple[LineLayer, str], Any] = {}
        self._drawn: dict[tuple[LineLayer, str], bytes] = {}
        self._chosen: tuple[str, str] | None = None
        self._highlight: list[Any] = []
        self._highlighted = b""

    def update(self, view: SessionView, anchors: dict[str, Pose]) -> None:
        """Draw what differs from what is there."""
        tracked = view.tracked()
        for agent in view.agent_names():
            colour = np.array(colour_of(agent))
            corrected = view.world_from_cameras(agent, anchors)
            self._draw_path("paths", agent, corrected, colour)
            self._draw_name(agent, corrected)
            before = view.world_from_cameras(agent, tracked)
            self._draw_path("tracked paths", agent, before, colour // 2)
        loops = [c for c in view.loops if c.source in anchors and c.target in anchors]
        for layer, verdict in _VERDICT.items():
            self._draw_loops(layer, [c for c in loops if c.verdict == verdict], anchors)
        self._draw_chosen(loops, anchors)

    def show(self, layers: dict[Any, bool], hidden_agents: set[str]) -> None:
        """Show the layers that are on, without the agents that are hidden."""
        for (layer, agent), handle in self._handles.items():
            handle.visible = layers[layer] and agent not in hidden_agents

    def choose(self, loop: LoopCandidate | None) -> None:
        """Highlight a loop, from the next update on; None takes the highlight away."""
        self._chosen = None if loop is None else (loop.source, loop.target)

    def _draw_path(
        self, layer: LineLayer, agent: str, parts: list[NDArray], colour: NDArray
    ) -> None:
        points = _segments([part[:, :3, 3] for part in parts])
        if self._is_new((layer, agent), points, colour):
            self._draw_lines((layer, agent), points, colour)

    def _draw_name(self, agent: str, parts: list[NDArray]) -> None:
        """An agent's name, where it was last."""
        key: tuple[LineLayer, str] = ("names", agent)
        place = parts[-1][-1][:3, 3] if parts else np.zeros(0)
        if len(place) == 0 or not self._is_new(key, place):
            return
        if key not in self._handles:
            self._handles[key] = self._server.scene.add_label(
                f"/names/{agent}", agent, anchor="bottom-center"
            )
        self._handles[key].position = tuple(place)

    def _draw_loops(
        self, layer: LineLayer, loops: list[LoopCandidate], anchors: dict[str, Pose]
    ) -> None:
        shown = [on_surface(loop_colour(c)) for c in loops]
        colours = np.array(shown, np.uint8).reshape(-1, 3)
        points = np.array([_ends(c, anchors) for c in loops], np.float32).reshape(-1, 2, 3)
        if self._is_new((layer, "lines"), points, colours):
            self._draw_lines((layer, "lines"), points, np.repeat(colours[:, None], 2, axis=1))
            self._draw_marks(layer, loops, points.mean(axis=1), colours)

    def _draw_marks(
        self,
        layer: LineLayer,
        loops: list[LoopCandidate],
        places: NDArray[np.float32],
        colours: NDArray[np.uint8],
    ) -> None:
        """A small body half-way along each loop, which can be clicked."""
        key = (layer, "marks")
        if key in self._handles:
            self._handles.pop(key).remove()
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
        self._handles[key] = handle

    def _draw_chosen(self, loops: list[LoopCandidate], anchors: dict[str, Pose]) -> None:
        """The chosen loop in white, thick, with a larger mark in its colour."""
        chosen = next((c for c in loops if (c.source, c.target) == self._chosen), None)
        ends = np.zeros((0, 3)) if chosen is None else _ends(chosen, anchors)
        state = ends.tobytes() + repr(chosen and loop_colour(chosen)).encode()
        if state == self._highlighted:
            return
        self._highlighted = state
        for handle in self._highlight:
            handle.remove()
        self._highlight = []
        if chosen is not None:
            scene = self._server.scene
            line = scene.add_line_segments(
                "/chosen/line", np.asarray(ends[None], np.float32), _WHITE,
                thickness=6.0, thickness_units="screen",
            )  # fmt: skip
            mark = scene.add_mesh_simple(
                "/chosen/mark", _CHOSEN_M * _OCTAHEDRON, _FACES,
                color=loop_colour(chosen), flat_shading=True, position=tuple(ends.mean(axis=0)),
            )  # fmt: skip
            self._highlight = [line, mark]

    def _draw_lines(self, key: tuple[LineLayer, str], points: NDArray, colours: NDArray) -> None:
        """Replace one set of line segments (n, 2, 3)."""
        if key in self._handles:
            self._handles.pop(key).remove()
        if len(points) == 0:
            return
        node = "/" + "/".join(part.replace(" ", "_") for part in key)
        self._handles[key] = self._server.scene.add_line_segments(
            node, np.asarray(points, np.float32), colours,
            thickness=2.5, thickness_units="screen",
        )  # fmt: skip

    def _is_new(self, key: tuple[LineLayer, str], *arrays: NDArray) -> bool:
        """Whether these are not the points and colours drawn last; they are from now on."""
        state = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).digest()
        if self._drawn.get(key) == state:
            return False
        self._drawn[key] = state
        return True


def _ends(loop: LoopCandidate, anchors: dict[str, Pose]) -> NDArray[np.float64]:
    return np.stack([anchors[loop.source][:3, 3], anchors[loop.target][:3, 3]])


def _segments(paths: list[NDArray]) -> NDArray:
    """(n, 2, 3): the steps of each path, and those from one to the next."""
    if not paths:
        return np.zeros((0, 2, 3), np.float32)
    points = np.concatenate(paths)
    return np.stack([points[:-1], points[1:]], axis=1)
