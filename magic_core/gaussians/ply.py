"""Gaussian clouds as standard 3DGS PLY files, which SuperSplat and other viewers open.

The layout is that of Kerbl et al., "3D Gaussian Splatting" (2023), with degree-0 spherical
harmonics only: x y z, nx ny nz (zero), f_dc_0..2, opacity (logit), scale_0..2 (natural logarithm of
metres), rot_0..3 (wxyz), all float32, binary little-endian.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError

from magic_core.errors import CorruptData
from magic_core.gaussians.cloud import GaussianCloud

SH_DEGREE_0 = 0.5 / np.sqrt(np.pi)
"""The constant spherical harmonic Y_00: colour = 0.5 + SH_DEGREE_0 * f_dc."""

OUR_AXES = "x right, y down, z forward of the first camera"
_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_FIELDS = (*_POSITION, *_NORMAL, *_COLOUR, "opacity", *_SCALE, *_ROTATION)
_MIN_OPACITY = 1e-6
_MIN_SCALE_M = 1e-9


def write_ply(
    path: Path | str, cloud: GaussianCloud, *, comment: str = "", axes: str = OUR_AXES
) -> Path:
    """Write a cloud; the file is replaced in one step, never left half written.

    `axes` is what the file says of the cloud's axes.
    """
    comments = [f"metres; axes {axes}"]
    comments += [comment] if comment else []
    return write_vertices(Path(path), rows(cloud), comments)


def write_vertices(path: Path, vertices: NDArray, comments: Sequence[str]) -> Path:
    """Write structured rows (n,) as the vertices of a binary PLY, in one step."""
    data = PlyData(
        [PlyElement.describe(vertices, "vertex")], byte_order="<", comments=list(comments)
    )
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        data.write(str(partial))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def rows(cloud: GaussianCloud) -> NDArray:
    """The vertices of a cloud, one structured row per Gaussian."""
    vertices = np.zeros(len(cloud), dtype=[(name, "<f4") for name in _FIELDS])
    _put(vertices, _POSITION, cloud.means)
    _put(vertices, _COLOUR, (cloud.colours - 0.5) / np.float32(SH_DEGREE_0))
    opacities = np.clip(cloud.opacities.astype(np.float64), _MIN_OPACITY, 1.0 - _MIN_OPACITY)
    vertices["opacity"] = np.log(opacities / (1.0 - opacities))
    _put(vertices, _SCALE, np.log(np.maximum(cloud.scales, _MIN_SCALE_M)))
    _put(vertices, _ROTATION, cloud.quaternions)
    return vertices


def header(count: int, *, axes: str = OUR_AXES) -> bytes:
    """The text before `count` rows."""
    lines = ["ply", "format binary_little_endian 1.0", f"comment metres; axes {axes}"]
    lines += [f"element vertex {count}", *(f"property float {name}" for name in _FIELDS)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def read_ply(path: Path | str) -> GaussianCloud:
    """Read a 3DGS PLY; higher harmonics are dropped, quaternions normalised.

    Raises CorruptData where the file is no 3DGS PLY or holds non-finite numbers.
    """
    try:
        vertices = PlyData.read(str(path))["vertex"].data
    except (OSError, KeyError, ValueError, PlyParseError) as error:
        raise CorruptData(f"{path}: not readable as a PLY of vertices ({error})") from error
    missing = [name for name in _FIELDS if name not in _NORMAL and name not in vertices.dtype.names]
    if missing:
        raise CorruptData(
            f"{path}: no {', '.join(missing)}; expected the properties of a 3D Gaussian PLY"
        )
    rotation = _take(vertices, _ROTATION)
    norm = np.linalg.norm(rotation, axis=1, keepdims=True)
    cloud = GaussianCloud.from_arrays(
        _take(vertices, _POSITION),
        np.where(norm > 0, rotation / np.maximum(norm, 1e-12), (1.0, 0.0, 0.0, 0.0)),
        scales=np.exp(_take(vertices, _SCALE)),
        opacities=1.0 / (1.0 + np.exp(-vertices["opacity"].astype(np.float64))),
        colours=0.5 + SH_DEGREE_0 * _take(vertices, _COLOUR),
    )
    if not all(np.isfinite(array).all() for array in cloud.arrays()):
        raise CorruptData(f"{path}: holds NaN or infinity; the writer of the file is at fault")
    return cloud


def _put(vertices: NDArray, names: tuple[str, ...], values: NDArray) -> None:
    for column, name in enumerate(names):
        vertices[name] = values[:, column]


def _take(vertices: NDArray, names: tuple[str, ...]) -> NDArray[np.float64]:
    return np.stack([vertices[name].astype(np.float64) for name in names], axis=1)
