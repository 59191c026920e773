"""The shell of a flat: rooms with floors, walls, windows, skirting boards and door frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magic_core.data.synthetic.materials import Materials
from magic_core.data.synthetic.mesh import MeshBuilder
from magic_core.data.synthetic.textures import Texture

CEILING_M = 2.6
WALL_M = 0.12
DOOR_M = 2.05
_REVEAL_M = 0.16


@dataclass(frozen=True, slots=True)
class Opening:
    """A hole in a wall: from `start` to `end` along the wall's world axis, `low` to `high`."""

    start: float
    end: float
    low: float
    high: float

    @property
    def is_window(self) -> bool:
        return self.low > 0.0


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangular room: inner extent, surfaces, and openings by wall (w, n, e, s)."""

    low: tuple[float, float]
    high: tuple[float, float]
    floor: Texture
    walls: Mapping[str, Texture]
    openings: Mapping[str, Sequence[Opening]]


def build_room(b: MeshBuilder, m: Materials, room: Room) -> None:
    (x0, y0), (x1, y1) = room.low, room.high
    b.quad((x0, y0, 0), (x1 - x0, 0, 0), (0, y1 - y0, 0), room.floor)
    b.quad((x0, y1, CEILING_M), (x1 - x0, 0, 0), (0, y0 - y1, 0), m.ceiling, spacing_m=0.2)
    # Each wall runs so that the room lies to its right, which is the side a quad faces.
    corners = {"w": ((x0, y0), (x0, y1)), "n": ((x0, y1), (x1, y1)),
               "e": ((x1, y1), (x1, y0)), "s": ((x1, y0), (x0, y0))}  # fmt: skip
    for side, (start, end) in corners.items():
        holes = room.openings.get(side, ())
        _build_wall(b, m, np.array(start), np.array(end), room.walls[side], holes)


def _build_wall(
    b: MeshBuilder,
    m: Materials,
    start: np.ndarray,
    end: np.ndarray,
    texture: Texture,
    holes: Sequence[Opening],
) -> None:
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    axis = int(np.argmax(np.abs(along)))
    spans = []
    for hole in holes:
        ends = sorted((world - start[axis]) * along[axis] for world in (hole.start, hole.end))
        spans.append((ends[0], ends[1], hole))
    position = 0.0
    for first, last, hole in sorted(spans, key=lambda span: span[0]):
        _wall_piece(b, start, along, (position, first), (0.0, CEILING_M), texture)
        _wall_piece(b, start, along, (first, last), (hole.high, CEILING_M), texture)
        _wall_piece(b, start, along, (first, last), (0.0, hole.low), texture)
        _skirting(b, m, start, along, (position, first))
        if hole.is_window:
            _skirting(b, m, start, along, (first, last))
            _window(b, m, start + first * along, along, last - first, hole)
        position = last
    _wall_piece(b, start, along, (position, length), (0.0, CEILING_M), texture)
    _skirting(b, m, start, along, (position, length))


def _wall_piece(
    b: MeshBuilder,
    start: np.ndarray,
    along: np.ndarray,
    span: tuple[float, float],
    heights: tuple[float, float],
    texture: Texture,
) -> None:
    if span[1] - span[0] < 1e-6 or heights[1] - heights[0] < 1e-6:
        return
    origin = (*(start + span[0] * along), heights[0])
    reach = (span[1] - span[0]) * along
    b.quad(origin, (*reach, 0.0), (0.0, 0.0, heights[1] - heights[0]), texture)


def _skirting(
    b: MeshBuilder, m: Materials, start: np.ndarray, along: np.ndarray, span: tuple[float, float]
) -> None:
    if span[1] - span[0] < 0.05:
        return
    inward = np.array([along[1], -along[0]])
    corner = start + span[0] * along + 0.014 * inward
    reach = (span[1] - span[0]) * along
    b.quad((*corner, 0.0), (*reach, 0.0), (0, 0, 0.09), m.skirting, spacing_m=0.2)
    b.quad((*corner, 0.09), (*reach, 0.0), (*(-0.014 * inward), 0.0), m.skirting, spacing_m=0.2)


def _window(
    b: MeshBuilder,
    m: Materials,
    corner: np.ndarray,
    along: np.ndarray,
    width: float,
    hole: Opening,
) -> None:
    """Reveal, pane with the view, and a cross of bars, in the wall's own frame."""
    turn = float(np.rad2deg(np.arctan2(along[1], along[0])))
    height = hole.high - hole.low
    with b.placed(corner[0], corner[1], z=hole.low, turn_deg=turn):
        # Local x runs along the wall, the room is at -y, the outside at +y.
        b.quad((0, _REVEAL_M, 0), (width, 0, 0), (0, 0, height), m.window, spacing_m=0.3)
        b.quad((0, 0, 0), (width, 0, 0), (0, _REVEAL_M, 0), m.white_paint)
        b.quad((0, _REVEAL_M, height), (width, 0, 0), (0, -_REVEAL_M, 0), m.white_paint)
        b.quad((0, 0, 0), (0, _REVEAL_M, 0), (0, 0, height), m.white_paint)
        b.quad((width, _REVEAL_M, 0), (0, -_REVEAL_M, 0), (0, 0, height), m.white_paint)
        for x in (0.0, width / 2 - 0.025, width - 0.05):
            b.box((x, 0.09, 0), (x + 0.05, 0.13, height), m.white_paint)
        for z in (0.0, 0.62 * height, height - 0.05):
            b.box((0, 0.09, z), (width, 0.13, z + 0.05), m.white_paint)
        b.box((-0.06, -0.1, -0.04), (width + 0.06, 0.02, 0.0), m.white_paint)


def build_door_frames(b: MeshBuilder, m: Materials) -> None:
    gap, rim = WALL_M / 2 + 0.01, 0.07
    frames = (
        (5.86, 2.5, 90.0, 2.0, 2.2), (1.075, 4.66, 0.0, 0.95, DOOR_M),
        (8.075, 4.66, 0.0, 0.95, DOOR_M), (4.66, 6.075, 90.0, 0.95, DOOR_M),
    )  # fmt: skip
    for x, y, turn, width, height in frames:
        with b.placed(x, y, turn_deg=turn):
            w = width / 2
            for side in (-w, w - 0.03):
                b.box((side, -gap, 0), (side + 0.03, gap, height), m.white_paint)
            b.box((-w, -gap, height - 0.03), (w, gap, height), m.white_paint)
            b.quad((-w, -gap, 0.003), (width, 0, 0), (0, 2 * gap, 0), m.oak)
            for face in (-gap - 0.012, gap - 0.012):
                b.box((-w - rim, face, 0), (-w, face + 0.024, height + rim), m.white_paint)
                b.box((w, face, 0), (w + rim, face + 0.024, height + rim), m.white_paint)
                b.box((-w, face, height), (w, face + 0.024, height + rim), m.white_paint)
    for x, y, turn in ((1.53, 4.79, 5.0), (8.53, 4.79, 6.0), (4.79, 5.62, -86.0)):
        with b.placed(x, y, turn_deg=turn):
            leaf = 0.88
            b.box((0.0, -0.02, 0.01), (leaf, 0.02, DOOR_M - 0.04), m.white_paint, front=m.door)
            b.quad((leaf, 0.0205, 0.01), (-leaf, 0, 0), (0, 0, DOOR_M - 0.05), m.door)
