"""Coarse methods: hypotheses of how two views stand to each other, from nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magic_server.registration.config import Method, RegistrationConfig
from magic_server.registration.view import PreparedView


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A coarse transform and how many correspondences support it."""

    target_from_source: NDArray[np.float64]  # (4, 4)
    inliers: int
    method: Method


class CoarseMethod(Protocol):
    """A global registration method."""

    def propose(
        self, source: PreparedView, target: PreparedView, config: RegistrationConfig
    ) -> Iterator[Hypothesis]:
        """Hypotheses, likely ones first, computed as they are asked for."""
        ...


def coarse_method(name: Method) -> CoarseMethod:
    """The method of a name; its libraries are loaded only now."""
    if name == "visual":
        from magic_server.registration.visual import VisualMatching

        return VisualMatching()
    if name == "kiss":
        from magic_server.registration.kiss import KissMatching

        return KissMatching()
    from magic_server.registration.fpfh import FpfhRansac

    return FpfhRansac(name)
