"""The flat: four rooms in a ring, joined by an opening and three doors, furnished.

World: x east, y north, z up, metres; the floor is z = 0. Living room in the south-west, kitchen
south-east, study north-east, bedroom north-west.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magic_core.data.synthetic import furniture as f
from magic_core.data.synthetic.lighting import Lamp
from magic_core.data.synthetic.materials import Materials
from magic_core.data.synthetic.mesh import MeshBuilder
from magic_core.data.synthetic.shell import (
    CEILING_M,
    DOOR_M,
    WALL_M,
    Opening,
    Room,
    build_door_frames,
    build_room,
)

_WARM = (1.0, 0.86, 0.68)


def build_flat(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> list[Lamp]:
    """Build everything into `b`; returns the lamps."""
    for room in _rooms(m):
        build_room(b, m, room)
    build_door_frames(b, m)
    _living_room(b, m, rng)
    _kitchen(b, m, rng)
    _study(b, m, rng)
    _bedroom(b, m, rng)
    return _lamps()


def _rooms(m: Materials) -> list[Room]:
    to_kitchen = Opening(1.5, 3.5, 0.0, 2.2)
    to_bedroom = Opening(0.6, 1.55, 0.0, DOOR_M)
    to_study = Opening(7.6, 8.55, 0.0, DOOR_M)
    between = Opening(5.6, 6.55, 0.0, DOOR_M)
    same = dict.fromkeys("wnes", m.living_wall)
    living = Room(
        (0.0, 0.0), (5.8, 4.6), m.parquet, {**same, "w": m.accent_wall},
        {"n": [to_bedroom], "e": [to_kitchen],
         "s": [Opening(0.7, 1.9, 0.85, 2.2), Opening(3.9, 5.1, 0.85, 2.2)]},
    )  # fmt: skip
    kitchen = Room(
        (5.8 + WALL_M, 0.0), (10.0, 4.6), m.kitchen_tiles, dict.fromkeys("wnes", m.kitchen_wall),
        {"w": [to_kitchen], "n": [to_study], "e": [Opening(2.3, 3.7, 1.0, 2.15)]},
    )  # fmt: skip
    study = Room(
        (4.6 + WALL_M, 4.6 + WALL_M), (10.0, 8.0), m.planks,
        {**dict.fromkeys("wnes", m.study_wall), "n": m.study_bricks},
        {"s": [to_study], "w": [between], "e": [Opening(5.7, 7.1, 0.95, 2.15)]},
    )  # fmt: skip
    bedroom = Room(
        (0.0, 4.6 + WALL_M), (4.6, 8.0), m.carpet,
        {**dict.fromkeys("wnes", m.study_wall), "n": m.bedroom_wall, "w": m.living_wall},
        {"s": [to_bedroom], "e": [between], "w": [Opening(5.7, 7.1, 0.95, 2.15)]},
    )  # fmt: skip
    return [living, kitchen, study, bedroom]


def _living_room(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    with b.placed(2.9, 0.62, turn_deg=180):
        f.sofa(b, m, width=2.2)
    b.box((1.5, 1.15, 0.0), (4.3, 2.85, 0.012), m.rugs[0], spacing_m=0.1)
    with b.placed(2.9, 1.95, turn_deg=4):
        f.coffee_table(b, m, rng)
    with b.placed(0.85, 1.75, turn_deg=118):
        f.armchair(b, m)
    with b.placed(3.0, 4.34):
        f.dresser(b, m, size=(1.9, 0.44, 0.5), front=m.drawers, body=m.oak)
    with b.placed(2.85, 4.38, z=0.525):
        f.television(b, m)
    with b.placed(3.75, 4.32, z=0.525):
        f.vase(b, m, variant=1)
    for x in (4.65, 5.35):
        with b.placed(x, 4.43):
            f.bookshelf(b, m, rng, width=0.7, height=2.05, wood=m.walnut)
    with b.placed(0.17, 3.25, turn_deg=90):
        f.bookshelf(b, m, rng, width=1.1, height=1.5, wood=m.oak)
    with b.placed(0.2, 3.05, z=1.51):
        f.globe(b, m)
    with b.placed(0.45, 0.45):
        f.plant(b, m, rng, height=1.5)
    with b.placed(5.4, 3.95):
        f.plant(b, m, rng, height=1.0)
    with b.placed(4.5, 0.45):
        f.floor_lamp(b, m)
    with b.placed(5.2, 0.75, turn_deg=-128):
        f.armchair(b, m)
    for x, variant in ((0.55, 0), (2.05, 0), (3.75, 0), (5.25, 0)):
        with b.placed(x, 0.1):
            f.curtain(b, m.curtain[variant], width=0.36, height=2.38)
    _hang(b, m, "s", 2.9, 0.0, [(0.0, 1.0, 0.75, 1.62, 0), (-0.72, 0.36, 0.46, 1.5, 1),
                               (0.72, 0.36, 0.46, 1.5, 3)])  # fmt: skip
    _hang(b, m, "w", 1.55, 0.0, [(0.0, 0.8, 0.8, 1.6, 2), (0.85, 0.42, 0.55, 1.7, 5)])
    _hang(b, m, "n", 2.2, 4.6, [(-0.3, 0.4, 0.55, 1.65, 4)])
    _hang(b, m, "n", 3.85, 4.6, [(-0.05, 0.5, 0.5, 1.75, 6)])
    _hang(b, m, "e", 0.75, 5.8, [(0.0, 0.6, 0.8, 1.55, 7)])
    with b.placed(5.8, 4.05, turn_deg=-90):
        b.box((-0.16, -0.03, 1.6), (0.16, 0.0, 1.92), m.dark_metal, front=m.clock)
    with b.placed(2.9, 2.2):
        f.ceiling_light(b, m, ceiling_m=CEILING_M)


def _hang(
    b: MeshBuilder,
    m: Materials,
    side: str,
    position: float,
    wall: float,
    items: Sequence[tuple[float, float, float, float, int]],
) -> None:
    """Hang (shift, width, height, middle, painting) around a position along a wall."""
    turn = {"n": 0.0, "e": -90.0, "s": 180.0, "w": 90.0}[side]
    x, y = (position, wall) if side in "ns" else (wall, position)
    with b.placed(x, y, turn_deg=turn):
        for shift, width, height, middle, number in items:
            frame = (m.walnut, m.dark_metal, m.pine)[number % 3]
            with b.placed(shift, -0.002):
                f.picture(
                    b, frame, m.paintings[number % len(m.paintings)],
                    width=width, height=height, z=middle,
                )  # fmt: skip


def _kitchen(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    top, depth = 0.9, 0.6
    # Counter along the south wall, from the west to the fridge in the corner.
    b.box((6.9, 0.0, 0.08), (9.3, depth, top), m.cabinet)
    b.quad((9.3, depth + 0.002, 0.08), (-2.4, 0, 0), (0, 0, top - 0.08), m.cabinet_fronts)
    b.box((6.88, 0.0, top), (9.32, depth + 0.03, top + 0.04), m.worktop, spacing_m=0.08)
    b.quad((9.3, 0.006, top + 0.04), (-2.4, 0, 0), (0, 0, 0.55), m.backsplash)
    b.box((6.9, 0.0, 1.5), (8.0, 0.34, 2.25), m.cabinet)
    b.quad((8.0, 0.342, 1.5), (-1.1, 0, 0), (0, 0, 0.75), m.cabinet_fronts)
    b.box((8.05, 0.0, 1.62), (8.65, 0.45, 1.72), m.steel)
    b.box((8.2, 0.0, 1.72), (8.5, 0.3, CEILING_M), m.steel)
    b.box((8.7, 0.0, 1.5), (9.3, 0.34, 2.25), m.cabinet)
    b.box((9.34, 0.0, 0.0), (9.98, 0.68, 1.95), m.steel)
    for z in (0.75, 1.2):
        b.box((9.42, 0.68, z), (9.46, 0.72, z + 0.35), m.dark_metal)
    for k, (x, z) in enumerate(((9.6, 1.55), (9.75, 1.25), (9.62, 1.0), (9.82, 1.6))):
        b.quad((x + 0.09, 0.683, z), (-0.15, 0, 0), (0, 0, 0.15), m.paintings[8 + k])
    for x, y in ((8.2, 0.2), (8.5, 0.2), (8.2, 0.45), (8.5, 0.45)):
        b.cylinder((x, y, top + 0.04), 0.09, 0.012, m.dark_metal)
    b.cylinder((8.22, 0.22, top + 0.052), 0.1, 0.14, m.ceramics[1])
    with b.placed(7.2, 0.25, z=top + 0.04):
        f.vase(b, m, variant=1)
    f.bowl(b, m, at=(7.7, 0.32, top + 0.04))
    for k in range(4):
        b.cylinder((8.85 + 0.11 * k, 0.16, top + 0.04), 0.045, 0.12 + 0.03 * k, m.ceramics[k % 3])
    _dining_corner(b, m, rng)
    _hang(b, m, "e", 1.4, 10.0, [(0.0, 0.55, 0.75, 1.55, 9)])
    _hang(b, m, "e", 4.15, 10.0, [(0.0, 0.4, 0.5, 1.75, 2)])
    _hang(b, m, "n", 6.75, 4.6, [(-0.35, 0.5, 0.5, 1.65, 10), (0.3, 0.5, 0.65, 1.6, 11)])
    _hang(b, m, "w", 0.85, 5.8 + WALL_M, [(0.0, 0.7, 0.5, 1.6, 12)])
    with b.placed(9.2, 4.6):
        b.box((-0.18, -0.04, 1.55), (0.18, 0.0, 1.91), m.dark_metal, front=m.clock)
    with b.placed(9.62, 4.2):
        f.plant(b, m, rng, height=1.5)


def _dining_corner(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    with b.placed(8.75, 2.3):
        b.box((-1.15, -0.95, 0.0), (1.15, 0.95, 0.01), m.rugs[1], spacing_m=0.1)
        f.table(b, m, size=(1.5, 0.9))
        f.bowl(b, m, at=(0.12, 0.05, 0.74))
        f.stack_of_books(b, m, rng, at=(-0.45, 0.1, 0.74), count=3)
        with b.placed(-0.12, -0.1, z=0.74):
            f.vase(b, m, variant=0)
        for k, (x, y, turn) in enumerate(
            ((-0.4, -0.62, 176), (0.4, -0.6, 188), (-0.38, 0.64, 4), (0.42, 0.62, -8))
        ):
            with b.placed(x, y, turn_deg=turn):
                f.chair(b, m, seat=m.cushions[k])
        f.pendant(b, m, drop=0.85, ceiling_m=CEILING_M)


def _study(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    with b.placed(7.3, 7.6):
        f.desk(b, m, rng)
    with b.placed(7.25, 6.95, turn_deg=192):
        f.chair(b, m, seat=m.armchair)
    for x in (5.4, 6.1):
        with b.placed(x, 7.83):
            f.bookshelf(b, m, rng, width=0.7, height=2.1, wood=m.pine)
    with b.placed(9.1, 7.7):
        f.dresser(b, m, size=(1.3, 0.5, 0.8), front=m.drawers, body=m.oak)
    with b.placed(9.4, 7.68, z=0.825):
        f.globe(b, m)
    f.stack_of_books(b, m, rng, at=(8.8, 7.68, 0.825), count=6)
    with b.placed(9.35, 5.35, turn_deg=-60):
        f.armchair(b, m)
    with b.placed(6.2, 4.92, turn_deg=180):
        f.bookshelf(b, m, rng, width=1.2, height=1.1, wood=m.walnut)
    with b.placed(5.9, 4.95, z=1.12):
        f.vase(b, m, variant=0)
    b.box((5.9, 5.5, 0.0), (8.4, 7.0, 0.012), m.rugs[2], spacing_m=0.1)
    with b.placed(5.1, 7.2):
        f.plant(b, m, rng, height=1.3)
    posters = ((7.3, "n", 8.0, 0), (6.2, "s", 4.6 + WALL_M, 1), (9.2, "n", 8.0, 2))
    for x, side, wall, number in posters:
        with b.placed(x, wall, turn_deg=0.0 if side == "n" else 180.0):
            f.picture(b, m.walnut, m.posters[number], width=0.57, height=0.76, z=1.75)
    _hang(b, m, "e", 5.15, 10.0, [(0.0, 0.5, 0.6, 1.6, 13)])
    _hang(b, m, "w", 6.95, 4.6 + WALL_M, [(0.0, 0.42, 0.56, 1.65, 4)])
    _hang(b, m, "s", 5.3, 4.6 + WALL_M, [(0.0, 0.6, 0.45, 1.6, 0)])
    with b.placed(7.2, 6.3):
        f.ceiling_light(b, m, ceiling_m=CEILING_M)


def _bedroom(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    b.box((0.9, 5.3, 0.0), (3.9, 7.0, 0.012), m.rugs[3], spacing_m=0.1)
    with b.placed(2.4, 6.88):
        f.bed(b, m)
    for x in (1.2, 3.6):
        with b.placed(x, 7.72):
            f.dresser(b, m, size=(0.46, 0.42, 0.46), front=m.drawers, body=m.oak)
        with b.placed(x, 7.74, z=0.485):
            f.table_lamp(b, m)
    with b.placed(3.48, 5.04, turn_deg=180):
        f.dresser(b, m, size=(1.9, 0.58, 2.1), front=m.wardrobe, body=m.pine)
    with b.placed(0.3, 5.1):
        f.plant(b, m, rng, height=1.2)
    for y in (5.5, 7.3):
        with b.placed(0.1, y, turn_deg=90):
            f.curtain(b, m.curtain[1], width=0.4, height=2.35)
    _hang(b, m, "n", 2.4, 8.0, [(0.0, 0.9, 0.55, 1.65, 3), (-0.85, 0.4, 0.5, 1.65, 7),
                               (0.85, 0.4, 0.5, 1.65, 1)])  # fmt: skip
    _hang(b, m, "e", 7.3, 4.6, [(0.0, 0.6, 0.75, 1.6, 8)])
    with b.placed(2.3, 6.0):
        f.ceiling_light(b, m, ceiling_m=CEILING_M)


def _lamps() -> list[Lamp]:
    def lamp(x: float, y: float, z: float, power: float) -> Lamp:
        red, green, blue = (power * channel for channel in _WARM)
        return Lamp((x, y, z), (red, green, blue))

    return [
        lamp(2.9, 2.2, 2.36, 5.0), lamp(4.5, 0.45, 1.78, 1.8), lamp(8.75, 2.3, 1.72, 3.2),
        lamp(7.2, 6.3, 2.36, 4.5), lamp(2.3, 6.0, 2.36, 4.0), lamp(1.2, 7.74, 1.0, 0.7),
        lamp(3.6, 7.74, 1.0, 0.7), lamp(7.6, 0.7, 2.1, 2.0), lamp(6.72, 7.78, 1.12, 0.6),
    ]  # fmt: skip
