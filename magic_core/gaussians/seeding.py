"""New Gaussians from an RGB-D image: where they are needed, how many, how large.

Two ways. `seed_uniform` is the paper's: a uniform sample of the pixels in need, isotropic, sized by
the distance to the nearest neighbour. `seed_adaptive` is ours: a quadtree over the image gives one
flat Gaussian per block of even colour and normal, so that a wall costs few and a book cover many;
its size follows from the block's footprint on the surface, its axes from the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.surface import Surface
from magic_core.geometry import Camera

Mask = NDArray[np.bool_]
Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SeedShape:
    """How a seed is made from its footprint."""

    spread: float = 0.5
    """Standard deviation along the surface, in block sides."""
    flatness: float = 0.2
    """Standard deviation along the normal, as a share of that along the surface."""
    max_slant: float = 3.0
    """Bound of 1 / cos(angle between ray and normal): how far a footprint may stretch."""
    opacity: float = 0.9
    """Opacity at birth."""


@dataclass(frozen=True, slots=True)
class BlockRule:
    """When a block of pixels is even enough for one Gaussian."""

    largest: int = 8
    """Side of the largest block in pixels: a power of two."""
    smallest: int = 1
    """Side of the smallest block in pixels: a power of two."""
    colour_deviation: float = 0.03
    """Largest root mean square deviation from the block's mean colour; colours span 0 to 1."""
    normal_agreement: float = 0.97
    """Least length of the mean of the block's unit normals."""
    depth_deviation: float = 0.005
    """Largest relative standard deviation of inverse depth: a Gaussian is rendered at one depth."""


@dataclass(frozen=True, slots=True)
class _Blocks:
    """Leaves of the quadtree, one row each."""

    centres: NDArray[np.float64]  # (n, 2) pixels (u, v)
    sides: NDArray[np.float64]  # (n,) pixels
    colours: NDArray[np.float32]  # (n, 3)
    inverse_depths: NDArray[np.float32]  # (n,) 1/m
    normals: NDArray[np.float32]  # (n, 3) not normalised


def seed_adaptive(
    colour: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: Camera,
    *,
    surface: Surface,
    need: Mask,
    rule: BlockRule,
    shape: SeedShape,
    limit: int,
) -> GaussianCloud:
    """Flat Gaussians, in the camera frame, that cover the reliable pixels in need.

    At most `limit` are made: the colour tolerance is doubled until they fit, and where even that
    does not do, seeds are left out evenly.
    """
    wanted = need & surface.reliable & (np.abs(surface.normals).sum(axis=-1) > 0)
    tolerance = rule.colour_deviation
    blocks = _quadtree(colour, depth, surface.normals, wanted, rule, tolerance)
    while len(blocks.sides) > limit and tolerance < 1.0:
        tolerance *= 2.0
        blocks = _quadtree(colour, depth, surface.normals, wanted, rule, tolerance)
    kept = np.linspace(0, len(blocks.sides) - 1, min(limit, len(blocks.sides))).astype(np.int64)
    return _flat_gaussians(blocks, camera, shape).select(kept)


def seed_uniform(
    colour: NDArray[np.uint8],
    depth: NDArray[np.float32],
    camera: Camera,
    *,
    need: Mask,
    count: int,
    existing: NDArray[np.float32],
    rng: np.random.Generator,
    opacity: float = 0.5,
) -> GaussianCloud:
    """The paper's seeds: `count` of the pixels in need, drawn uniformly; in the camera frame.

    Scales are the distance to the nearest neighbour among the seeds and the `existing` means
    (m, 3), camera frame (paper, supplement, "Mapping").
    """
    from scipy.spatial import KDTree

    pixels = np.flatnonzero(need & (depth > 0))
    if len(pixels) > count:
        pixels = np.sort(rng.choice(pixels, size=count, replace=False))
    means = camera.back_project(depth).reshape(-1, 3)[pixels]
    if len(means) == 0:
        return GaussianCloud.empty()
    tree = KDTree(np.concatenate([means, existing.reshape(-1, 3)]))
    nearest = tree.query(means, k=2)[0][:, 1] if tree.n > 1 else np.full(len(means), 0.01)
    quaternions = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(means), 1))
    return GaussianCloud.from_arrays(
        means,
        quaternions,
        scales=np.repeat(np.clip(nearest, 1e-4, 1.0)[:, None], 3, axis=1),
        opacities=np.full(len(means), opacity),
        colours=colour.reshape(-1, 3)[pixels] / 255.0,
    )


def pixels_in_need(
    alpha: Image,
    expected_depth: Image,
    depth: Image,
    *,
    alpha_threshold: float,
    depth_error_factor: float,
    depth_floor: float = 0.0,
) -> Mask:
    """Pixels with a reading that the rendered map does not explain (paper, "Mapping").

    Low alpha, or a depth error above `depth_error_factor` times the frame's median error and above
    `depth_floor`, a share of the depth that the sensor's noise may reach. All images (h, w), m.
    """
    known = depth > 0
    covered = known & (alpha >= alpha_threshold)
    error = np.abs(expected_depth - depth)
    median = float(np.median(error[covered])) if covered.any() else 0.0
    limit = np.maximum(depth_error_factor * median, depth_floor * depth)
    return known & ((alpha < alpha_threshold) | (error > limit))


def _quadtree(
    colour: NDArray[np.uint8],
    depth: NDArray[np.float32],
    normals: Image,
    wanted: Mask,
    rule: BlockRule,
    tolerance: float,
) -> _Blocks:
    """Merge 2x2 blocks bottom-up while they stay even; return the leaves."""
    inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-6), 0.0)
    squares = (inverse**2)[..., None]
    values = colour.astype(np.float32) / 255.0
    stack = np.concatenate(
        [values, (values**2).sum(axis=-1)[..., None], normals, inverse[..., None], squares], axis=-1
    ).astype(np.float32)  # summed over blocks: rgb, r^2+g^2+b^2, normal, inverse depth, its square
    whole, side, levels = wanted, 1, []
    while True:
        levels.append((side, stack, whole))
        if side == rule.largest or min(whole.shape) < 2:
            break
        stack, whole = _pooled(stack), _all_four(whole)
        side *= 2
        whole = whole & (_even(stack, side, rule, tolerance) | (side <= rule.smallest))
    return _leaves(levels, rule.smallest)


def _pooled(stack: Image) -> Image:
    """Sums over 2x2 blocks of an (h, w, c) image; an odd last row or column is left out."""
    h, w = stack.shape[0] // 2 * 2, stack.shape[1] // 2 * 2
    rows = stack[0:h:2, :w] + stack[1:h:2, :w]
    return np.asarray(rows[:, 0::2] + rows[:, 1::2], np.float32)


def _all_four(mask: Mask) -> Mask:
    h, w = mask.shape[0] // 2 * 2, mask.shape[1] // 2 * 2
    rows = mask[0:h:2, :w] & mask[1:h:2, :w]
    return rows[:, 0::2] & rows[:, 1::2]


def _even(stack: Image, side: int, rule: BlockRule, tolerance: float) -> Mask:
    mean = stack / float(side * side)
    variance = mean[..., 3] - (mean[..., :3] ** 2).sum(axis=-1)
    agreement = np.linalg.norm(mean[..., 4:7], axis=-1)
    depth_variance = mean[..., 8] - mean[..., 7] ** 2
    even_depth = depth_variance < (rule.depth_deviation * mean[..., 7]) ** 2
    return (variance < 3.0 * tolerance**2) & (agreement > rule.normal_agreement) & even_depth


def _leaves(levels: list[tuple[int, Image, Mask]], smallest: int) -> _Blocks:
    """The whole blocks that no larger whole block covers."""
    found: list[_Blocks] = []
    for (side, stack, whole), larger in zip(levels, [*levels[1:], None], strict=True):
        leaf = whole.copy()
        if larger is not None:
            covered = np.repeat(np.repeat(larger[2], 2, axis=0), 2, axis=1)
            leaf[: covered.shape[0], : covered.shape[1]] &= ~covered
        rows, columns = np.nonzero(leaf)
        if side < smallest:  # thin out what is too small to merge: one pixel of each block
            keep = (rows % (smallest // side) == 0) & (columns % (smallest // side) == 0)
            rows, columns = rows[keep], columns[keep]
        mean = stack[rows, columns] / float(side * side)
        corners = np.stack([columns, rows], axis=-1).astype(np.float64)
        centres = np.asarray(corners * side + 0.5 * (side - 1), np.float64)
        sides = np.full(len(rows), float(max(side, smallest)))
        found.append(_Blocks(centres, sides, mean[:, :3], mean[:, 7], mean[:, 4:7]))
    return _Blocks(
        *(
            np.concatenate([getattr(blocks, name) for blocks in found])
            for name in ("centres", "sides", "colours", "inverse_depths", "normals")
        )
    )


def _flat_gaussians(blocks: _Blocks, camera: Camera, shape: SeedShape) -> GaussianCloud:
    """One Gaussian per block, camera frame: axes (steepest slant, across it, normal)."""
    if len(blocks.sides) == 0:
        return GaussianCloud.empty()
    z = 1.0 / np.maximum(blocks.inverse_depths.astype(np.float64), 1e-6)
    rays = np.stack(
        [
            (blocks.centres[:, 0] - camera.cx) / camera.fx,
            (blocks.centres[:, 1] - camera.cy) / camera.fy,
            np.ones(len(z)),
        ],
        axis=-1,
    )
    axes, cosine = _surface_axes(blocks.normals.astype(np.float64), rays)
    width = shape.spread * blocks.sides * z / np.sqrt(camera.fx * camera.fy)
    stretch = np.minimum(1.0 / np.maximum(cosine, 1e-3), shape.max_slant)
    return GaussianCloud.from_arrays(
        rays * z[:, None],
        _quaternions(axes),
        scales=np.stack([width * stretch, width, width * shape.flatness], axis=-1),
        opacities=np.full(len(z), shape.opacity),
        colours=np.clip(blocks.colours, 0.0, 1.0),
    )


def _surface_axes(
    normals: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (n, 3, 3), columns (slant, across, normal), and cos(ray, normal) (n,)."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    along = (rays * normals).sum(axis=-1, keepdims=True)
    slant = rays - along * normals
    # A ray along the normal leaves no slant direction: any tangent will do.
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    fallback = np.asarray(np.cross(normals, helper), np.float64)
    slant = np.where(np.linalg.norm(slant, axis=-1, keepdims=True) > 1e-4, slant, fallback)
    slant /= np.linalg.norm(slant, axis=-1, keepdims=True)
    across = np.asarray(np.cross(normals, slant), np.float64)
    return np.stack([slant, across, normals], axis=-1), np.abs(along[:, 0])


def _quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit wxyz quaternions (n, 4) of (n, 3, 3) rotations."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
