"""KISS-Matcher (Lim et al. 2025): faster-PFH features, graph-theoretic pruning, robust solver."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import kiss_matcher as _kiss_matcher
import numpy as np

from magic_server.registration.coarse import Hypothesis
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.view import PreparedView

# The package re-exports its extension module at run time.
kiss_matcher: Any = _kiss_matcher

VOXEL_SIZES_M = (0.08, 0.05)
"""Feature sizes that are tried, each giving one hypothesis; the larger is faster, the
smaller finds a few more."""
LEAST_POINTS = 100


class KissMatching:
    """One hypothesis per voxel size. Deterministic where OpenMP runs on one thread."""

    def propose(
        self, source: PreparedView, target: PreparedView, config: RegistrationConfig
    ) -> Iterator[Hypothesis]:
        if min(len(source.points), len(target.points)) < LEAST_POINTS:
            return
        for voxel in VOXEL_SIZES_M:
            hypothesis = self._match(source, target, voxel)
            if hypothesis is not None:
                yield hypothesis

    def _match(self, source: PreparedView, target: PreparedView, voxel: float) -> Hypothesis | None:
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=voxel))
        solution = matcher.estimate(source.points, target.points)
        transform = np.eye(4)
        transform[:3, :3] = np.asarray(solution.rotation)
        transform[:3, 3] = np.asarray(solution.translation).reshape(3)
        if not np.isfinite(transform).all():
            return None
        return Hypothesis(transform, int(matcher.get_num_final_inliers()), "kiss")
