"""Furniture built of patches. Each piece stands on z = 0 around the local origin and faces -y."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magic_core.data.synthetic.materials import Materials
from magic_core.data.synthetic.mesh import MeshBuilder
from magic_core.data.synthetic.textures import Texture

_FINE_M = 0.07


def legs(
    b: MeshBuilder, texture: Texture, *, size: Sequence[float], height: float, side: float = 0.05
) -> None:
    """Four legs at the corners of a (width, depth) rectangle."""
    x, y = size[0] / 2 - side, size[1] / 2 - side
    for sx in (-1, 1):
        for sy in (-1, 1):
            low = (sx * x - side / 2, sy * y - side / 2, 0.0)
            b.box(low, (low[0] + side, low[1] + side, height), texture)


def table(b: MeshBuilder, m: Materials, *, size: Sequence[float], height: float = 0.74) -> None:
    """A wooden table."""
    w, d = size[0] / 2, size[1] / 2
    b.box((-w, -d, height - 0.04), (w, d, height), m.oak, spacing_m=_FINE_M)
    b.box((-w + 0.08, -d + 0.08, height - 0.12), (w - 0.08, d - 0.08, height - 0.04), m.oak)
    legs(b, m.oak, size=(size[0] - 0.06, size[1] - 0.06), height=height - 0.04, side=0.06)


def chair(b: MeshBuilder, m: Materials, *, seat: Texture) -> None:
    """A dining chair with a cushion; its back is towards +y."""
    legs(b, m.walnut, size=(0.44, 0.44), height=0.44, side=0.04)
    b.box((-0.22, -0.22, 0.42), (0.22, 0.22, 0.45), m.walnut, spacing_m=_FINE_M)
    b.box((-0.2, -0.2, 0.45), (0.2, 0.18, 0.49), seat, spacing_m=_FINE_M)
    for x in (-0.2, 0.16):
        b.box((x, 0.18, 0.44), (x + 0.04, 0.22, 0.94), m.walnut)
    for z in (0.58, 0.72, 0.86):
        b.box((-0.17, 0.19, z), (0.17, 0.21, z + 0.07), m.walnut)


def sofa(b: MeshBuilder, m: Materials, *, width: float = 2.1) -> None:
    """A sofa with seat cushions and throw pillows."""
    w = width / 2
    b.box((-w, -0.42, 0.10), (w, 0.42, 0.34), m.sofa)
    b.box((-w, 0.20, 0.34), (w, 0.44, 0.82), m.sofa, spacing_m=_FINE_M)
    for x in (-w - 0.12, w - 0.06):
        b.box((x, -0.42, 0.10), (x + 0.18, 0.44, 0.60), m.sofa, spacing_m=_FINE_M)
    seats = 3
    step = (width - 0.14) / seats
    for k in range(seats):
        x = -w + 0.07 + k * step
        b.box((x + 0.01, -0.40, 0.34), (x + step - 0.01, 0.20, 0.46), m.sofa, spacing_m=_FINE_M)
    for k, (x, turn) in enumerate(((-w + 0.28, 12), (-w + 0.74, -8), (w - 0.3, -14))):
        with b.placed(x, 0.10, z=0.46, turn_deg=turn):
            _pillow(b, m.cushions[k % len(m.cushions)])


def _pillow(b: MeshBuilder, texture: Texture, *, size: float = 0.42) -> None:
    """A cushion leaning back: thick in the middle."""
    s = np.linspace(-1, 1, 9)
    grid_s, grid_t = np.meshgrid(s, s, indexing="ij")
    bulge = 0.075 * np.sqrt(np.clip((1 - grid_s**2) * (1 - grid_t**2), 0, 1)) + 0.004
    for side in (-1, 1):
        points = np.empty((9, 9, 3))
        points[..., 0] = -side * grid_s * size / 2
        height = (grid_t + 1) * size / 2
        points[..., 1] = 0.28 * height + side * bulge - 0.06
        points[..., 2] = 0.96 * height
        b.surface(points, texture)


def armchair(b: MeshBuilder, m: Materials) -> None:
    """An upholstered armchair."""
    legs(b, m.walnut, size=(0.7, 0.7), height=0.14)
    b.box((-0.36, -0.36, 0.14), (0.36, 0.36, 0.42), m.armchair, spacing_m=_FINE_M)
    b.box((-0.36, 0.20, 0.42), (0.36, 0.40, 0.92), m.armchair, spacing_m=_FINE_M)
    for x in (-0.44, 0.32):
        b.box((x, -0.36, 0.14), (x + 0.12, 0.40, 0.60), m.armchair, spacing_m=_FINE_M)
    with b.placed(0.0, 0.08, z=0.42, turn_deg=6):
        _pillow(b, m.cushions[2], size=0.40)


def coffee_table(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    """A low table with a shelf, books, a vase and a bowl."""
    b.box((-0.55, -0.32, 0.38), (0.55, 0.32, 0.42), m.walnut, spacing_m=_FINE_M)
    b.box((-0.5, -0.28, 0.12), (0.5, 0.28, 0.14), m.walnut)
    legs(b, m.walnut, size=(1.1, 0.64), height=0.38)
    stack_of_books(b, m, rng, at=(-0.28, 0.02, 0.42), count=4)
    stack_of_books(b, m, rng, at=(0.1, 0.0, 0.14), count=5)
    with b.placed(0.30, 0.08, z=0.42):
        vase(b, m, variant=0)
    bowl(b, m, at=(0.08, -0.16, 0.42))


def stack_of_books(
    b: MeshBuilder, m: Materials, rng: np.random.Generator, *, at: Sequence[float], count: int
) -> None:
    """Books lying on each other, slightly turned."""
    z = at[2]
    for k in range(count):
        thickness = float(rng.uniform(0.02, 0.045))
        cover = m.paintings[int(rng.integers(len(m.paintings)))]
        with b.placed(at[0], at[1], z=z, turn_deg=float(rng.uniform(-14, 14))):
            w, d = 0.14 - 0.008 * k, 0.1 - 0.005 * k
            spine = m.cushions[int(rng.integers(len(m.cushions)))]
            b.box((-w, -d, 0.0), (w, d, thickness), spine, top=cover, spacing_m=_FINE_M)
        z += thickness


def vase(b: MeshBuilder, m: Materials, *, variant: int) -> None:
    """A vase with a few stems of leaves."""
    profile = ((0.045, 0.0), (0.075, 0.05), (0.08, 0.11), (0.045, 0.2), (0.035, 0.24), (0.05, 0.27))
    b.revolved((0, 0, 0), profile, m.ceramics[variant % len(m.ceramics)], sides=16)
    _leaves(b, m, count=9, height=0.28, reach=0.2, base=0.26, leaf=m.leaf[variant % 2])


def bowl(b: MeshBuilder, m: Materials, *, at: Sequence[float]) -> None:
    """A bowl of fruit."""
    profile = ((0.05, 0.0), (0.11, 0.04), (0.14, 0.09), (0.13, 0.088), (0.06, 0.03), (1e-4, 0.02))
    b.revolved(at, profile, m.ceramics[2], sides=18)
    for k in range(5):
        angle = 2 * np.pi * k / 4
        reach = 0.06 if k < 4 else 0.0
        centre = (
            at[0] + reach * np.cos(angle), at[1] + reach * np.sin(angle),
            at[2] + (0.085 if k < 4 else 0.135),
        )  # fmt: skip
        b.ball(centre, 0.042, m.fruit[k % len(m.fruit)], sides=12)


def plant(b: MeshBuilder, m: Materials, rng: np.random.Generator, *, height: float = 1.3) -> None:
    """A pot plant of bent leaves."""
    profile = ((0.13, 0.0), (0.19, 0.3), (0.205, 0.34), (0.18, 0.34), (0.17, 0.3), (1e-4, 0.29))
    b.revolved((0, 0, 0), profile, m.terracotta, sides=20)
    b.cylinder((0, 0, 0.28), 0.022, 0.25 * height, m.walnut, sides=8)
    leaf = m.leaf[int(rng.integers(2))]
    for level, count in ((0.34, 7), (0.48, 8), (0.62, 7)):
        turn = float(rng.uniform(0, 60))
        with b.placed(0, 0, turn_deg=turn):
            _leaves(b, m, count=count, height=0.5 * height, reach=0.42, base=level, leaf=leaf)


def _leaves(
    b: MeshBuilder,
    m: Materials,
    *,
    count: int,
    height: float,
    reach: float,
    base: float,
    leaf: Texture,
) -> None:
    """A rosette of arched leaves around the vertical through the origin."""
    for k in range(count):
        angle = 2 * np.pi * (k + 0.3 * (k % 3)) / count
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        side = np.array([-out[1], out[0], 0.0])
        t = np.linspace(0, 1, 7)
        vigour = 0.75 + 0.25 * np.sin(7.3 * k + 10 * base)
        spine = reach * vigour * t[:, None] * out
        spine = spine + (base + height * vigour * (1.15 * t - 0.55 * t**2))[:, None] * (0, 0, 1)
        width = 0.18 * reach * np.sin(np.pi * np.clip(t * 0.97 + 0.03, 0, 1)) + 0.004
        points = np.stack([spine - width[:, None] * side, spine + width[:, None] * side], axis=1)
        b.surface(points, leaf)


def bookshelf(
    b: MeshBuilder,
    m: Materials,
    rng: np.random.Generator,
    *,
    width: float = 1.2,
    height: float = 2.0,
    wood: Texture,
) -> None:
    """Shelves of books, vases and boxes."""
    w, depth, board = width / 2, 0.30, 0.025
    b.box((-w, -depth / 2, 0), (-w + board, depth / 2, height), wood)
    b.box((w - board, -depth / 2, 0), (w, depth / 2, height), wood)
    b.quad((-w, depth / 2, 0), (width, 0, 0), (0, 0, height), wood)
    rows = round(height / 0.36)
    step = (height - board) / rows
    for row in range(rows + 1):
        z = row * step
        b.box((-w, -depth / 2, z), (w, depth / 2, z + board), wood)
        if row < rows:
            _shelf_content(b, m, rng, low=(-w + 0.04, z + board), high=(w - 0.04, z + step - 0.03))


def _shelf_content(
    b: MeshBuilder,
    m: Materials,
    rng: np.random.Generator,
    *,
    low: tuple[float, float],
    high: tuple[float, float],
) -> None:
    x = low[0]
    while x < high[0] - 0.12:
        kind = rng.uniform()
        if kind < 0.70:
            length = min(float(rng.uniform(0.3, 0.6)), high[0] - x)
            front = m.books[int(rng.integers(len(m.books)))]
            depth = float(rng.uniform(-0.12, -0.05))
            top = min(high[1], low[1] + float(rng.uniform(0.22, 0.30)))
            b.box((x, depth, low[1]), (x + length, 0.12, top), m.linen, front=front)
        elif kind < 0.85:
            length = 0.2
            with b.placed(x + 0.1, 0.0, z=low[1]):
                profile = ((0.04, 0), (0.075, 0.08), (0.05, 0.17), (0.035, 0.2))
                b.revolved((0, 0, 0), profile, m.ceramics[int(rng.integers(3))], sides=14)
        else:
            length = min(0.28, high[0] - x)
            texture = m.cushions[int(rng.integers(len(m.cushions)))]
            b.box((x, -0.11, low[1]), (x + length - 0.02, 0.1, low[1] + 0.2), texture)
        x += length + 0.02


def floor_lamp(b: MeshBuilder, m: Materials) -> None:
    """A standing lamp; its light itself is a Lamp of the layout."""
    b.cylinder((0, 0, 0), 0.15, 0.025, m.dark_metal)
    b.cylinder((0, 0, 0.025), 0.014, 1.42, m.dark_metal, sides=8)
    b.revolved((0, 0, 1.38), ((0.21, 0.0), (0.14, 0.28)), m.shade, sides=20)
    b.revolved((0, 0, 1.38), ((0.135, 0.28), (0.205, 0.0)), m.shade, sides=20)


def table_lamp(b: MeshBuilder, m: Materials) -> None:
    """A small lamp with a ceramic foot."""
    b.revolved(
        (0, 0, 0), ((0.06, 0), (0.075, 0.06), (0.02, 0.2), (0.012, 0.26)), m.ceramics[0], sides=14
    )
    b.revolved((0, 0, 0.24), ((0.14, 0.0), (0.09, 0.17)), m.shade, sides=18)


def pendant(b: MeshBuilder, m: Materials, *, drop: float, ceiling_m: float) -> None:
    """A lamp hanging from the ceiling by `drop` metres."""
    z = ceiling_m - drop
    b.cylinder((0, 0, z + 0.2), 0.006, drop - 0.2, m.dark_metal, sides=6)
    b.revolved(
        (0, 0, z), ((0.23, 0.0), (0.17, 0.12), (0.05, 0.2), (1e-4, 0.21)), m.terracotta, sides=24
    )
    b.ball((0, 0, z + 0.04), 0.07, m.glow, sides=14)


def ceiling_light(b: MeshBuilder, m: Materials, *, ceiling_m: float) -> None:
    """A flat round lamp on the ceiling."""
    profile = ((1e-4, -0.09), (0.14, -0.08), (0.21, -0.04), (0.22, 0.0))
    b.revolved((0, 0, ceiling_m), profile, m.glow, sides=20)


def bed(b: MeshBuilder, m: Materials) -> None:
    """A double bed, its head towards +y."""
    b.box((-0.85, -1.0, 0.08), (0.85, 1.02, 0.30), m.walnut)
    b.box((-0.82, -0.98, 0.30), (0.82, 1.0, 0.50), m.linen)
    b.box((-0.86, -1.02, 0.34), (0.86, 0.45, 0.56), m.duvet, spacing_m=_FINE_M)
    b.box((-0.92, 1.02, 0.0), (0.92, 1.08, 1.10), m.walnut, spacing_m=_FINE_M)
    for x in (-0.42, 0.42):
        with b.placed(x, 0.68, z=0.50, turn_deg=4 * x):
            _pillow(b, m.linen, size=0.56)
        with b.placed(x * 0.9, 0.46, z=0.52, turn_deg=-8 * x):
            _pillow(b, m.cushions[1 if x < 0 else 3], size=0.38)


def dresser(
    b: MeshBuilder, m: Materials, *, size: Sequence[float], front: Texture, body: Texture
) -> None:
    """A chest whose front carries drawn drawers or doors; size = (width, depth, height)."""
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    b.box((-w + 0.03, -d + 0.03, 0.0), (w - 0.03, d, 0.08), m.dark_metal)
    b.box((-w, -d, 0.08), (w, d, h), body, front=front)
    b.box((-w - 0.015, -d - 0.015, h), (w + 0.015, d, h + 0.025), body, spacing_m=_FINE_M)


def television(b: MeshBuilder, m: Materials) -> None:
    """A television on a foot."""
    b.box((-0.2, -0.1, 0.0), (0.2, 0.1, 0.02), m.dark_metal)
    b.box((-0.03, -0.02, 0.02), (0.03, 0.02, 0.1), m.dark_metal)
    b.box((-0.6, -0.03, 0.1), (0.6, 0.03, 0.8), m.dark_metal)
    b.quad((-0.58, -0.032, 0.12), (1.16, 0, 0), (0, 0, 0.66), m.television)


def desk(b: MeshBuilder, m: Materials, rng: np.random.Generator) -> None:
    """A desk with a monitor, a keyboard, papers and a lamp."""
    table(b, m, size=(1.5, 0.72))
    b.box((-0.12, 0.1, 0.74), (0.12, 0.26, 0.76), m.dark_metal)
    b.box((-0.02, 0.2, 0.76), (0.02, 0.23, 0.9), m.dark_metal)
    b.box((-0.34, 0.17, 0.86), (0.34, 0.2, 1.26), m.dark_metal)
    b.quad((-0.33, 0.168, 0.87), (0.66, 0, 0), (0, 0, 0.38), m.screen)
    b.box((-0.22, -0.16, 0.74), (0.2, -0.02, 0.765), m.dark_metal)
    stack_of_books(b, m, rng, at=(0.52, 0.12, 0.74), count=5)
    b.box((0.34, -0.25, 0.74), (0.56, 0.02, 0.748), m.linen, top=m.posters[1])
    with b.placed(-0.58, 0.18, z=0.74):
        table_lamp(b, m)


def globe(b: MeshBuilder, m: Materials) -> None:
    """A globe on a foot."""
    b.cylinder((0, 0, 0), 0.1, 0.02, m.walnut)
    b.cylinder((0, 0, 0.02), 0.012, 0.08, m.walnut, sides=8)
    b.ball((0, 0, 0.24), 0.15, m.globe, sides=20)


def picture(
    b: MeshBuilder, frame: Texture, image: Texture, *, width: float, height: float, z: float
) -> None:
    """A framed picture hanging on a wall at y = 0, seen from -y; z is its middle."""
    w, h, rim = width / 2, height / 2, 0.03
    b.box((-w - rim, -0.03, z - h - rim), (w + rim, 0.0, z + h + rim), frame)
    b.quad((-w, -0.032, z - h), (width, 0, 0), (0, 0, height), image)


def curtain(b: MeshBuilder, texture: Texture, *, width: float, height: float) -> None:
    """A curtain in folds hanging from `height` to just above the floor."""
    s, t = np.linspace(0, 1, 33), np.linspace(0, 1, 9)
    points = np.empty((33, 9, 3))
    points[..., 0] = (width * (s - 0.5))[:, None]
    points[..., 1] = 0.035 * np.sin(2 * np.pi * 5 * s)[:, None]
    points[..., 2] = (0.05 + (height - 0.05) * t)[None]
    b.surface(points, texture)
