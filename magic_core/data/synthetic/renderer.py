"""Antialiased pictures and exact depth of a lit mesh.

One ray per pixel finds depth and surface; only pixels at the border between two surfaces cast
four more. Elsewhere samples are intersected with the known triangle's plane, so that textures
are supersampled, where a surface is seen at an angle, for the price of a lookup.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from magic_core.data.synthetic.lighting import linear_from_srgb
from magic_core.data.synthetic.mesh import Mesh
from magic_core.data.synthetic.shading import shade
from magic_core.geometry import Camera

Float32 = NDArray[np.float32]

_SUBPIXELS = np.array([(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)], np.float32)
_MAX_SHOWN_EMISSION = 1.6


@dataclass(frozen=True, slots=True)
class Picture:
    """What one exposure of the virtual camera gives."""

    colour: NDArray[np.uint8]  # (h, w, 3) RGB
    depth: Float32  # (h, w) exact metres along z; 0 where nothing is hit
    cosine: Float32  # (h, w) of the angle between viewing ray and surface normal


class MeshRenderer:
    """Renders a mesh with baked light. Rendering several frames at once from threads is safe."""

    def __init__(self, mesh: Mesh, light: Float32, caster: o3d.t.geometry.RaycastingScene) -> None:
        self._mesh = mesh
        self._caster = caster
        self._light = np.ascontiguousarray(light, np.float32)
        self._texels, self._levels = _mip_chains(mesh)
        emission = np.array([texture.emission for texture in mesh.textures], np.float32)
        self._glow = np.minimum(emission, _MAX_SHOWN_EMISSION)[mesh.patch_texture]
        self._exposure = _exposure(mesh, light)
        self._linear = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)

    def render(self, camera: Camera, world_from_camera: NDArray[np.float64]) -> Picture:
        """Colour and depth seen by a camera with OpenCV axes."""
        rays = _world_directions(camera.rays(), world_from_camera)
        answer = self._cast(world_from_camera, rays)
        triangles = answer["primitive_ids"].numpy().astype(np.int32)
        depth = answer["t_hit"].numpy()
        hit = np.isfinite(depth)
        triangles[~hit] = -1
        samples = np.repeat(triangles[..., None], len(_SUBPIXELS), axis=-1)
        border = self._surface_borders(triangles)
        samples[border] = self._cast_samples(camera, world_from_camera, border)
        along = np.einsum("hwc,hwc->hw", answer["primitive_normals"].numpy(), rays)
        cosine = np.abs(along) / np.sqrt(np.einsum("hwc,hwc->hw", rays, rays))
        colour = np.empty((camera.height, camera.width, 3), np.uint8)
        shade(
            samples, border, cosine, _SUBPIXELS,
            np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32),
            world_from_camera.astype(np.float32),
            self._mesh.vertices, self._mesh.triangles, self._mesh.texture_uv, self._light,
            self._mesh.triangle_patch, self._mesh.patch_texture, self._mesh.patch_texels_per_m,
            self._glow, self._texels, self._levels, self._linear, self._exposure, colour,
        )  # fmt: skip
        return Picture(colour, np.where(hit, depth, 0).astype(np.float32), cosine)

    def _cast_samples(
        self, camera: Camera, world_from_camera: NDArray, where: NDArray[np.bool_]
    ) -> NDArray[np.int32]:
        """(k, 4) triangles seen by the four samples of the chosen pixels; -1 = none."""
        shift = np.zeros((len(_SUBPIXELS), 3), np.float32)
        shift[:, :2] = _SUBPIXELS / np.array([camera.fx, camera.fy], np.float32)
        rays = camera.rays()[where][:, None, :] + shift
        answer = self._cast(world_from_camera, _world_directions(rays, world_from_camera))
        hit = np.isfinite(answer["t_hit"].numpy())
        return np.where(hit, answer["primitive_ids"].numpy().astype(np.int32), -1)

    def _cast(self, world_from_camera: NDArray, directions: Float32) -> dict[str, o3d.core.Tensor]:
        rays = np.empty((*directions.shape[:-1], 6), np.float32)
        rays[..., :3] = world_from_camera[:3, 3]
        rays[..., 3:] = directions
        return self._caster.cast_rays(o3d.core.Tensor.from_numpy(rays))

    def _surface_borders(self, triangles: NDArray[np.int32]) -> NDArray[np.bool_]:
        """(h, w) pixels with another surface among their eight neighbours."""
        patch = np.where(triangles >= 0, self._mesh.triangle_patch[triangles], -1)
        patch = patch.astype(np.float32)  # exact: there are far fewer than 2^24 patches
        kernel = np.ones((3, 3), np.uint8)
        return cv2.dilate(patch, kernel) != cv2.erode(patch, kernel)


def _world_directions(rays: Float32, world_from_camera: NDArray) -> Float32:
    """Rays (..., 3) with camera z = 1, turned into the world: t along them is depth."""
    columns = world_from_camera[:3, :3].T.astype(np.float32)
    # Not a matrix product: its threads would compete with those that cast the rays.
    return rays[..., :1] * columns[0] + rays[..., 1:2] * columns[1] + rays[..., 2:] * columns[2]


def _mip_chains(mesh: Mesh) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """All textures' mip levels in one array, and (texture, level, [start, h, w]) to find them."""
    parts, table, start = [], [], 0
    for texture in mesh.textures:
        rows, image = [], texture.image
        while True:
            rows.append((start, image.shape[0], image.shape[1]))
            parts.append(image.reshape(-1, 3))
            start += image.shape[0] * image.shape[1]
            if min(image.shape[:2]) <= 2:
                break
            size = (image.shape[1] // 2, image.shape[0] // 2)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        table.append(rows)
    levels = max(len(rows) for rows in table)
    padded = [rows + [rows[-1]] * (levels - len(rows)) for rows in table]
    return np.concatenate(parts), np.array(padded, np.int64)


def _exposure(mesh: Mesh, light: Float32) -> float:
    """Brings the scene's mid tones to middle grey, once for all cameras."""
    means = np.array(
        [linear_from_srgb(t.image[::4, ::4] / 255.0).mean(axis=(0, 1)) for t in mesh.textures]
    )
    radiance = light.mean(axis=1) * means[mesh.patch_texture][mesh.vertex_patch].mean(axis=1)
    return float(0.16 / max(float(np.median(radiance)), 1e-6))
