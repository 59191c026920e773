"""KISS-Matcher (Lim et al. 2025): faster-PFH features, graph-theoretic pruning, robust solver."""

from __future__ import annotations

import contextlib
import os
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
_begun = False


@contextlib.contextmanager
def _on_one_core_at_first() -> Iterator[None]:
    """Let the library see one core at its first call in this process.

    Its own copy of TBB then starts as many threads as there are cores and obeys no variable. More
    than one would disturb the other workers, and add up in an order that changes the result.
    """
    global _begun
    if _begun or not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
    _begun = True


class KissMatching:
    """One hypothesis per voxel size. Deterministic where OpenMP runs on one thread, as in jobs."""

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
        with _on_one_core_at_first():
            solution = matcher.estimate(source.points, target.points)
        transform = np.eye(4)
        transform[:3, :3] = np.asarray(solution.rotation)
        transform[:3, 3] = np.asarray(solution.translation).reshape(3)
        if not np.isfinite(transform).all():
            return None
        return Hypothesis(transform, int(matcher.get_num_final_inliers()), "kiss")
