"""Building a textured triangle mesh out of surface patches.

World axes of the synthetic scenes: x east, y north, z up, metres. Every patch is a grid of
vertices fine enough to carry baked light, with texture coordinates and an outward normal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.data.synthetic.textures import Texture
from magic_core.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mesh:
    """A textured triangle mesh; triangles of one patch share texture and patch number."""

    vertices: NDArray[np.float32]  # (v, 3) world, metres
    normals: NDArray[np.float32]  # (v, 3) unit, outward
    texture_uv: NDArray[np.float32]  # (v, 2) in repeats of the texture
    vertex_patch: NDArray[np.int32]  # (v,)
    triangles: NDArray[np.int32]  # (t, 3)
    triangle_patch: NDArray[np.int32]  # (t,)
    patch_texture: NDArray[np.int32]  # (p,) index into textures
    patch_texels_per_m: NDArray[np.float32]  # (p,)
    textures: tuple[Texture, ...]


@dataclass(frozen=True, slots=True)
class _Patch:
    points: Array  # (n, m, 3)
    normals: Array  # (n, m, 3)
    uv: Array  # (n, m, 2)
    texture: Texture
    texels_per_m: float


class MeshBuilder:
    """Collects patches; `placed` moves everything that is built inside it."""

    def __init__(self, *, spacing_m: float) -> None:
        self.spacing_m = spacing_m
        self._patches: list[_Patch] = []
        self._world_from_local = np.eye(4)

    @contextmanager
    def placed(
        self, x: float, y: float, *, z: float = 0.0, turn_deg: float = 0.0
    ) -> Iterator[None]:
        """Build in a local frame whose origin lies at (x, y, z), turned about the vertical."""
        outer = self._world_from_local
        rotation = se3.rotation_exp((0.0, 0.0, np.deg2rad(turn_deg)))
        self._world_from_local = outer @ se3.from_rotation_translation(rotation, (x, y, z))
        try:
            yield
        finally:
            self._world_from_local = outer

    def quad(
        self,
        origin: ArrayLike,
        along: ArrayLike,
        up: ArrayLike,
        texture: Texture,
        *,
        spacing_m: float | None = None,
    ) -> None:
        """A parallelogram; it faces along x up, its picture's base lies on `along`."""
        corner, along, up = (np.asarray(v, dtype=np.float64) for v in (origin, along, up))
        lengths = float(np.linalg.norm(along)), float(np.linalg.norm(up))
        step = spacing_m or self.spacing_m
        s = np.linspace(0, 1, max(1, int(np.ceil(lengths[0] / step))) + 1)
        t = np.linspace(0, 1, max(1, int(np.ceil(lengths[1] / step))) + 1)
        grid_s, grid_t = np.meshgrid(s, t, indexing="ij")
        points = corner + grid_s[..., None] * along + grid_t[..., None] * up
        normal = se3.hat(along) @ up  # numpy's own cross product costs ten times as much here
        normals = np.broadcast_to(normal / np.linalg.norm(normal), points.shape)
        # Metres from the local origin, so that neighbouring quads of a wall continue one pattern.
        metres = np.stack([points @ (along / lengths[0]), points @ (up / lengths[1])], axis=-1)
        self._add(points, normals, np.stack([grid_s, grid_t], axis=-1), metres, texture)

    def surface(self, points: Array, texture: Texture) -> None:
        """A curved sheet through an (n, m, 3) grid, seen and lit from both sides."""
        along, up = np.gradient(points, axis=0), np.gradient(points, axis=1)
        normals = np.cross(along, up)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        n, m = points.shape[:2]
        unit = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij"), -1)
        reach = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum(axis=0).mean()
        rise = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1).mean()
        metres = unit * (reach, rise)
        gap = 0.001 * normals
        self._add(points + gap, normals, unit, metres, texture)
        back = (points - gap)[::-1], -normals[::-1], unit[::-1], metres[::-1]
        self._add(*back, texture)

    def box(
        self,
        low: Sequence[float],
        high: Sequence[float],
        texture: Texture,
        *,
        top: Texture | None = None,
        front: Texture | None = None,
        spacing_m: float | None = None,
        bottom: bool = True,
    ) -> None:
        """An axis-aligned box; `front` is the face towards -y, `top` the one towards +z."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
        self.quad((x0, y0, z0), (dx, 0, 0), (0, 0, dz), front or texture, spacing_m=spacing_m)
        self.quad((x1, y1, z0), (-dx, 0, 0), (0, 0, dz), texture, spacing_m=spacing_m)
        self.quad((x1, y0, z0), (0, dy, 0), (0, 0, dz), texture, spacing_m=spacing_m)
        self.quad((x0, y1, z0), (0, -dy, 0), (0, 0, dz), texture, spacing_m=spacing_m)
        self.quad((x0, y0, z1), (dx, 0, 0), (0, dy, 0), top or texture, spacing_m=spacing_m)
        if bottom:
            self.quad((x0, y1, z0), (dx, 0, 0), (0, -dy, 0), texture, spacing_m=spacing_m)

    def revolved(
        self,
        centre: Sequence[float],
        profile: Sequence[tuple[float, float]],
        texture: Texture,
        *,
        sides: int = 24,
    ) -> None:
        """A surface of revolution about the vertical through `centre`.

        `profile` lists (radius, height) upwards along the outside; a radius of 0 closes it.
        """
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        outline = np.asarray(profile, dtype=np.float64)
        radius, height = outline[:, 0], outline[:, 1]
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points = np.empty((sides + 1, len(outline), 3))
        points[..., :2] = ring[:, None] * radius[None, :, None]
        points[..., 2] = height
        slope = np.gradient(outline, axis=0)
        outward = np.stack([slope[:, 1], -slope[:, 0]], axis=-1)
        outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-12)
        normals = np.empty_like(points)
        normals[..., :2] = ring[:, None] * outward[None, :, :1]
        normals[..., 2] = outward[:, 1]
        around = 2 * np.pi * float(radius.max())
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
        unit = np.stack(np.meshgrid(angle / (2 * np.pi), arc / arc[-1], indexing="ij"), axis=-1)
        points += np.asarray(centre, dtype=np.float64)
        self._add(points, normals, unit, unit * (around, arc[-1]), texture)

    def cylinder(
        self,
        centre: Sequence[float],
        radius: float,
        height: float,
        texture: Texture,
        *,
        sides: int = 16,
    ) -> None:
        """An upright cylinder with a flat top; `centre` is the middle of its base."""
        self.revolved(centre, ((radius, 0.0), (radius, height)), texture, sides=sides)
        top = (centre[0], centre[1], centre[2] + height)
        self.revolved(top, ((radius, 0.0), (1e-4, 1e-5)), texture, sides=sides)

    def ball(
        self, centre: Sequence[float], radius: float, texture: Texture, *, sides: int = 16
    ) -> None:
        """A sphere."""
        tilt = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
        profile = [(max(radius * float(np.cos(a)), 1e-4), radius * float(np.sin(a))) for a in tilt]
        self.revolved(centre, profile, texture, sides=sides)

    def _add(
        self, points: Array, normals: Array, unit: Array, metres: Array, texture: Texture
    ) -> None:
        """Add a grid; `unit` runs 0 to 1 along both axes, `metres` measures along them."""
        rotation, shift = self._world_from_local[:3, :3], self._world_from_local[:3, 3]
        height, width = texture.image.shape[:2]
        extent = np.ptp(metres.reshape(-1, 2), axis=0)
        if texture.size_m is None:
            uv = np.stack([unit[..., 0], 1.0 - unit[..., 1]], axis=-1)
            texels_per_m = width / max(float(extent[0]), 1e-6)
        else:
            if texture.grain and extent[1] > extent[0]:
                metres = metres[..., ::-1]
            repeat = np.array([texture.size_m, texture.size_m * height / width])
            uv = metres / repeat * (1.0, -1.0)
            uv = uv + self._offset(points) if texture.grain else uv
            texels_per_m = width / texture.size_m
        self._patches.append(
            _Patch(points @ rotation.T + shift, normals @ rotation.T, uv, texture, texels_per_m)
        )

    def _offset(self, points: Array) -> Array:
        """Shift each patch's tiling, so that no two boards show the same grain."""
        seed = points.reshape(-1, 3).sum(axis=0) @ (12.9898, 78.233, 37.719)
        return np.array([np.sin(seed) * 43.7585, np.cos(seed) * 23.421]) % 1.0

    def mesh(self) -> Mesh:
        """Everything built so far."""
        textures = list({id(patch.texture): patch.texture for patch in self._patches}.values())
        numbers = {id(texture): number for number, texture in enumerate(textures)}
        triangles, start = [], 0
        for patch in self._patches:
            n, m = patch.points.shape[:2]
            triangles.append(_grid_triangles(n, m) + start)
            start += n * m
        sizes = [patch.points.shape[0] * patch.points.shape[1] for patch in self._patches]
        patch_numbers = np.arange(len(self._patches), dtype=np.int32)
        return Mesh(
            vertices=_flat([p.points for p in self._patches], 3),
            normals=_flat([p.normals for p in self._patches], 3),
            texture_uv=_flat([p.uv for p in self._patches], 2),
            vertex_patch=np.repeat(patch_numbers, sizes),
            triangles=np.concatenate(triangles).astype(np.int32),
            triangle_patch=np.repeat(patch_numbers, [len(part) for part in triangles]),
            patch_texture=np.array([numbers[id(p.texture)] for p in self._patches], np.int32),
            patch_texels_per_m=np.array([p.texels_per_m for p in self._patches], np.float32),
            textures=tuple(textures),
        )


def _grid_triangles(n: int, m: int) -> NDArray[np.int64]:
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    first = np.stack([a, b, c], axis=-1).reshape(-1, 3)
    second = np.stack([a, c, d], axis=-1).reshape(-1, 3)
    return np.concatenate([first, second])


def _flat(parts: list[Array], width: int) -> NDArray[np.float32]:
    return np.concatenate([part.reshape(-1, width) for part in parts]).astype(np.float32)
