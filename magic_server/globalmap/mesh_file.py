"""Meshes as files: PLY for tools of geometry, GLB for viewers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from magic_server.globalmap.mesh import Mesh

MeshFormat = Literal["ply", "glb"]


def write_mesh(path: Path, mesh: Mesh, kind: MeshFormat) -> Path:
    """Write a mesh with colours and normals; the file is replaced in one step.

    PLY keeps colours as the images have them; glTF wants linear light (sRGB undone).
    """
    colours = linear_light(mesh.colours) if kind == "glb" else mesh.colours
    surface = trimesh.Trimesh(
        vertices=mesh.vertices,
        faces=mesh.triangles,
        vertex_normals=mesh.normals,
        vertex_colors=np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8),
        process=False,
    )
    partial = path.with_name(f".{path.name}.partial")
    try:
        normals = {"include_normals": True} if kind == "glb" else {"vertex_normal": True}
        surface.export(partial, file_type=kind, **normals)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def linear_light(srgb: NDArray) -> NDArray[np.float64]:
    """Linear intensities of sRGB values, both 0 to 1 (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
