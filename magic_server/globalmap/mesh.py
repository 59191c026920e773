"""A surface from the merged map: TSDF fusion of rendered depth and colour.

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images" (1996), as
the paper extracts its meshes. Open3D's VoxelBlockGrid does the fusion: its older ScalableTSDFVolume
integrates nothing in Open3D 0.20.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import Rasteriser, RenderedView
from magic_server.globalmap.config import MeshConfig

Float64 = NDArray[np.float64]

_BLOCK_SIDE = 16  # voxels
_FIRST_BLOCKS = 10_000  # the grid grows by itself
_LEAST_WEIGHT = 1.5  # surface that a single view showed is left out


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in the map's frame."""

    vertices: Float64  # (n, 3) metres
    triangles: NDArray[np.int32]  # (m, 3) anticlockwise seen from outside
    colours: Float64  # (n, 3) 0 to 1, in the encoding of the images
    normals: Float64  # (n, 3) unit, outward

    def reoriented(self, matrix: NDArray) -> Mesh:
        """The mesh in other axes (3, 3); triangles keep their outside under a mirror."""
        mirrored = np.linalg.det(matrix) < 0
        triangles = self.triangles[:, ::-1] if mirrored else self.triangles
        return Mesh(
            self.vertices @ np.asarray(matrix).T,
            np.ascontiguousarray(triangles),
            self.colours,
            self.normals @ np.asarray(matrix).T,
        )


def mesh_of(
    cloud: GaussianCloud,
    camera: Camera,
    poses: Float64,
    config: MeshConfig,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> Mesh:
    """Fuse what the map shows from poses (k, 4, 4) world_from_camera.

    Raises InvalidInput where there is nothing to fuse or nothing comes out.
    """
    config.validate()
    if not len(cloud) or not len(poses):
        raise InvalidInput.field("poses", "a mesh needs a map and at least one pose to see it from")
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32, o3d.core.float32),
        attr_channels=tuple(o3d.core.SizeVector([n]) for n in (1, 1, 3)),
        voxel_size=config.voxel_m,
        block_resolution=_BLOCK_SIDE,
        block_count=_FIRST_BLOCKS,
        device=o3d.core.Device("CPU:0"),
    )
    rasteriser = Rasteriser()
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(config.views, len(poses))).astype(int))
    for number, index in enumerate(chosen):
        view = rasteriser.render(cloud, camera, poses[index])
        _integrate(grid, view, camera, poses[index], config)
        progress((number + 1) / len(chosen))
    return _extracted(grid, config)


def _integrate(
    grid: o3d.t.geometry.VoxelBlockGrid,
    view: RenderedView,
    camera: Camera,
    world_from_camera: Float64,
    config: MeshConfig,
) -> None:
    seen = view.alpha >= config.min_alpha
    depth = np.where(seen, view.expected_depth, 0.0).astype(np.float32)
    if not ((depth > 0) & (depth < config.max_depth_m)).any():
        return
    # Colours are accumulated on black: divided by alpha they are the surface's own.
    colour = np.clip(view.colour / np.maximum(view.alpha, 1e-3)[..., None], 0.0, 1.0)
    depth_image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(depth[..., None].copy()))
    colour_image = o3d.t.geometry.Image(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(colour, np.float32))
    )
    intrinsics = o3d.core.Tensor.from_numpy(
        np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float64)
    )
    camera_from_world = o3d.core.Tensor.from_numpy(se3.inverse(world_from_camera))
    reach = config.truncation_m / config.voxel_m
    limits = (1.0, config.max_depth_m, reach)  # depth unit, farthest depth, truncation in voxels
    blocks = grid.compute_unique_block_coordinates(
        depth_image, intrinsics, camera_from_world, *limits
    )
    grid.integrate(
        blocks, depth_image, colour_image, intrinsics, intrinsics, camera_from_world, *limits
    )


def _extracted(grid: o3d.t.geometry.VoxelBlockGrid, config: MeshConfig) -> Mesh:
    mesh = grid.extract_triangle_mesh(weight_threshold=_LEAST_WEIGHT).to_legacy()
    if config.min_triangles and len(mesh.triangles):
        piece, size, _ = mesh.cluster_connected_triangles()
        small = np.asarray(size)[np.asarray(piece)] < config.min_triangles
        mesh.remove_triangles_by_mask(small.tolist())
        mesh.remove_unreferenced_vertices()
    if not len(mesh.triangles):
        raise InvalidInput.field(
            "mesh", "no surface came out; use larger voxels, or a smaller mesh.min_triangles"
        )
    mesh.compute_vertex_normals()
    return Mesh(
        np.asarray(mesh.vertices).copy(),
        np.asarray(mesh.triangles).astype(np.int32),
        np.clip(np.asarray(mesh.vertex_colors), 0.0, 1.0),
        np.asarray(mesh.vertex_normals).copy(),
    )
