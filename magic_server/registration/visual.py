"""SIFT keypoints with depth, matched and solved by a vectorised three-point RANSAC."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from magic_server.registration.coarse import Hypothesis
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.view import PreparedView, depth_sigma

Array = NDArray[np.float64]

RATIO = 0.9
"""Lowe's ratio test, loose: RANSAC sorts out the rest."""
SAMPLES = 2000
LEAST_MATCHES = 5
LEAST_SAMPLE_SPREAD_M = 0.1
"""Three points closer than this fix no rotation."""
SAME_M = 0.1
"""Hypotheses that agree on where the keypoints go to this are one."""


class VisualMatching:
    """Hypotheses from matched keypoints, best supported first."""

    def propose(
        self, source: PreparedView, target: PreparedView, config: RegistrationConfig
    ) -> Iterator[Hypothesis]:
        pairs = _matches(source.keypoint_descriptors, target.keypoint_descriptors)
        if len(pairs) < LEAST_MATCHES:
            return
        a = source.keypoints[pairs[:, 0]].astype(np.float64)
        b = target.keypoints[pairs[:, 1]].astype(np.float64)
        tolerance = 0.02 + 3.0 * (_sigma(a, config) + _sigma(b, config))
        transforms = _sampled_transforms(a, b, tolerance, np.random.default_rng(config.seed))
        if not len(transforms):
            return
        moved = a @ transforms[:, :3, :3].swapaxes(1, 2) + transforms[:, None, :3, 3]
        inlier = np.linalg.norm(moved - b, axis=2) < tolerance  # (samples, matches)
        yield from _distinct(a, b, inlier, tolerance, config)


def _sigma(points: Array, config: RegistrationConfig) -> Array:
    """Position noise of keypoints: depth noise at their distance from the anchor."""
    distance = np.linalg.norm(points, axis=1).astype(np.float32)
    return depth_sigma(distance, config).astype(np.float64)


def _matches(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.int64]:
    """Index pairs (m, 2) of mutual nearest descriptors that pass the ratio test."""
    if min(len(source), len(target)) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    similarity = source @ target.T
    best = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[best] == np.arange(len(source))
    top = np.partition(similarity, -2, axis=1)[:, -2:]
    # Unit vectors: squared distance is 2 - 2 similarity.
    distinct = (1.0 - top[:, 1]) < RATIO**2 * (1.0 - top[:, 0])
    kept = np.flatnonzero(mutual & distinct)
    return np.stack([kept, best[kept]], axis=1)


def _sampled_transforms(
    a: Array, b: Array, tolerance: Array, generator: np.random.Generator
) -> Array:
    """Rigid transforms (s, 4, 4) of random triplets whose side lengths agree in both views."""
    triplets = generator.integers(0, len(a), (SAMPLES, 3))
    rolled = np.roll(triplets, 1, axis=1)
    sides_a = np.linalg.norm(a[triplets] - a[rolled], axis=2)
    sides_b = np.linalg.norm(b[triplets] - b[rolled], axis=2)
    agree = np.abs(sides_a - sides_b) < tolerance[triplets] + tolerance[rolled]
    spread = (sides_a > LEAST_SAMPLE_SPREAD_M) & (sides_b > LEAST_SAMPLE_SPREAD_M)
    good = (agree & spread).all(axis=1)
    return _kabsch(a[triplets[good]], b[triplets[good]])


def _kabsch(a: Array, b: Array) -> Array:
    """Least-squares rigid transforms (s, 4, 4) from a (s, k, 3) to b (s, k, 3)."""
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd((b - mean_b).swapaxes(1, 2) @ (a - mean_a))
    sign = np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= sign[:, None]
    rotation = u @ vt
    transforms = np.tile(np.eye(4), (len(a), 1, 1))
    transforms[:, :3, :3] = rotation
    transforms[:, :3, 3] = (mean_b - mean_a @ rotation.swapaxes(1, 2))[:, 0]
    return transforms


def _distinct(
    a: Array, b: Array, inlier: NDArray[np.bool_], tolerance: Array, config: RegistrationConfig
) -> list[Hypothesis]:
    """Refitted transforms of the best samples that differ from each other."""
    found: list[Hypothesis] = []
    support = inlier.sum(axis=1)
    for sample in np.argsort(-support, kind="stable")[:50].tolist():
        if len(found) == config.max_hypotheses or support[sample] < 4:
            break
        transform, count = _refitted(a, b, inlier[sample], tolerance)
        where = a @ transform[:3, :3].T + transform[:3, 3]
        others = [a @ h.target_from_source[:3, :3].T + h.target_from_source[:3, 3] for h in found]
        if all(np.linalg.norm(where - other, axis=1).mean() > SAME_M for other in others):
            found.append(Hypothesis(transform, count, "visual"))
    return sorted(found, key=lambda hypothesis: -hypothesis.inliers)


def _refitted(a: Array, b: Array, inlier: NDArray[np.bool_], tolerance: Array) -> tuple[Array, int]:
    """Fit to the inliers, count again, twice."""
    transform = np.eye(4)
    for _ in range(2):
        if inlier.sum() < 3:
            break
        transform = _kabsch(a[None, inlier], b[None, inlier])[0]
        moved = a @ transform[:3, :3].T + transform[:3, 3]
        inlier = np.linalg.norm(moved - b, axis=1) < tolerance
    return transform, int(inlier.sum())
