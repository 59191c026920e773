"""Light baked into the vertices of a mesh: lamps, windows, soft shadows, reflected light.

Each vertex gathers over one fixed set of cosine-distributed directions, whose hits are kept, so
that every further bounce is a weighted sum and no ray is cast twice. Lamps too small to be found
by chance are sampled one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numba import njit
from numpy.typing import NDArray

from magic_core.data.synthetic.mesh import Mesh

Float32 = NDArray[np.float32]
_BIAS_M = 2e-3


@dataclass(frozen=True, slots=True)
class Lamp:
    """A small ball that shines in all directions."""

    position: tuple[float, float, float]  # world, metres
    power: tuple[float, float, float]  # radiant intensity per channel, linear
    radius_m: float = 0.12


@dataclass(frozen=True, slots=True)
class LightingConfig:
    """How finely light is computed."""

    directions: int = 112
    """Rays per vertex over the hemisphere."""
    lamp_samples: int = 6
    """Shadow rays per vertex and lamp."""
    bounces: int = 3
    """Reflections after the first."""
    ambient: float = 0.04
    """Light that stands for all further bounces."""


def linear_from_srgb(values: NDArray) -> Float32:
    """Linear light of sRGB values 0 to 1."""
    values = np.asarray(values, dtype=np.float32)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def bake(
    mesh: Mesh,
    caster: o3d.t.geometry.RaycastingScene,
    lamps: Sequence[Lamp],
    *,
    config: LightingConfig,
    rng: np.random.Generator,
) -> Float32:
    """(v, 3) irradiance over pi at every vertex: multiply by the albedo for the radiance seen."""
    albedo, emission = _patch_colours(mesh)
    direct = _lamp_light(mesh, caster, lamps, samples=config.lamp_samples, rng=rng)
    hits = _gather(mesh, caster, directions=config.directions, rng=rng)
    first = direct + _mean_over_hits(hits, emission[mesh.triangle_patch])
    total = first
    for _ in range(config.bounces):
        leaving = total[mesh.triangles].mean(axis=1) * albedo[mesh.triangle_patch]
        total = first + _mean_over_hits(hits, leaving.astype(np.float32))
    return _smoothed(mesh, np.asarray(total, np.float32)) + np.float32(config.ambient)


def _patch_colours(mesh: Mesh) -> tuple[Float32, Float32]:
    """Mean linear albedo and emission (p, 3) of every patch."""
    means = np.array(
        [linear_from_srgb(t.image[::4, ::4] / 255.0).mean(axis=(0, 1)) for t in mesh.textures]
    )
    emission = means * np.array([t.emission for t in mesh.textures])[:, None]
    return (
        means[mesh.patch_texture].astype(np.float32),
        emission[mesh.patch_texture].astype(np.float32),
    )


def _gather(
    mesh: Mesh,
    caster: o3d.t.geometry.RaycastingScene,
    *,
    directions: int,
    rng: np.random.Generator,
) -> NDArray[np.int32]:
    """(v, k) index of the triangle each vertex sees in each direction; -1 = none or its back."""
    golden = np.pi * (3.0 - np.sqrt(5.0))
    number = np.arange(directions)
    radius = np.sqrt((number + 0.5) / directions)
    angle = golden * number + rng.uniform(0, 2 * np.pi)
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])
    tangent, bitangent = _tangents(mesh.normals)
    frames = np.stack([tangent, bitangent, mesh.normals], axis=-1)  # (v, 3, 3)
    origins = mesh.vertices + _BIAS_M * mesh.normals
    hits = np.empty((len(origins), directions), np.int32)
    chunk = max(1, 2_000_000 // directions)
    for start in range(0, len(origins), chunk):
        part = slice(start, start + chunk)
        rays = np.empty((len(origins[part]), directions, 6), np.float32)
        rays[..., :3] = origins[part, None]
        rays[..., 3:] = np.swapaxes(frames[part] @ local, 1, 2)
        answer = caster.cast_rays(o3d.core.Tensor.from_numpy(rays))
        triangle = answer["primitive_ids"].numpy().astype(np.int32)
        facing = (answer["primitive_normals"].numpy() * rays[..., 3:]).sum(axis=-1) < 0
        seen = np.isfinite(answer["t_hit"].numpy()) & facing
        hits[part] = np.where(seen, triangle, -1)
    return hits


@njit(cache=True, nogil=True)
def _mean_over_hits(hits, values):
    """(v, 3) mean of the values (t, 3) of the triangles each vertex sees; a miss counts as 0."""
    result = np.zeros((hits.shape[0], 3), np.float32)
    for vertex in range(hits.shape[0]):
        for number in range(hits.shape[1]):
            triangle = hits[vertex, number]
            if triangle >= 0:
                for channel in range(3):
                    result[vertex, channel] += values[triangle, channel]
    return result / np.float32(hits.shape[1])


def _lamp_light(
    mesh: Mesh,
    caster: o3d.t.geometry.RaycastingScene,
    lamps: Sequence[Lamp],
    *,
    samples: int,
    rng: np.random.Generator,
) -> Float32:
    origins = mesh.vertices + _BIAS_M * mesh.normals
    total = np.zeros((len(origins), 3), np.float32)
    for lamp in lamps:
        offsets = rng.standard_normal((samples, 3))
        offsets *= lamp.radius_m / np.linalg.norm(offsets, axis=1, keepdims=True)
        for offset in offsets:
            toward = (np.asarray(lamp.position) + offset - origins).astype(np.float32)
            distance = np.linalg.norm(toward, axis=1)
            cosine = (toward * mesh.normals).sum(axis=1) / np.maximum(distance, 1e-6)
            lit = np.flatnonzero((cosine > 0) & (distance < 9.0))
            rays = np.concatenate([origins[lit], toward[lit]], axis=1).astype(np.float32)
            blocked = caster.test_occlusions(
                o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=0.999
            ).numpy()
            share = np.where(blocked, 0.0, cosine[lit] / np.maximum(distance[lit] ** 2, 0.05))
            total[lit] += (share[:, None] * np.asarray(lamp.power) / samples).astype(np.float32)
    return total / np.float32(np.pi)


def _tangents(normals: Float32) -> tuple[Float32, Float32]:
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent.astype(np.float32), np.cross(normals, tangent).astype(np.float32)


def _smoothed(mesh: Mesh, values: Float32, *, rounds: int = 1) -> Float32:
    """Average each vertex with its neighbours on the same patch: calms sampling noise."""
    edges = np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    edges = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(edges[:, 0], minlength=len(values))
    for _ in range(rounds):
        neighbours = np.stack(
            [np.bincount(edges[:, 0], values[edges[:, 1], c], len(values)) for c in range(3)],
            axis=1,
        )
        average = neighbours / np.maximum(count, 1)[:, None]
        values = (0.5 * values + 0.5 * average).astype(np.float32)
    return values
