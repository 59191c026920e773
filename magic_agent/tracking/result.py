"""What the tracker says of one frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Verdict = Literal["ok", "degenerate", "lost"]


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """A frame's pose and how far it can be believed."""

    anchor_from_camera: NDArray[np.float64]
    """(4, 4); where the verdict is `lost` this is the prediction, not a measurement."""
    information: NDArray[np.float64]
    """(6, 6) of anchor_from_camera: (translation, rotation), right perturbation."""
    verdict: Verdict
    """`degenerate`: some directions come from the motion prior alone."""
    reason: str
    """Why the frame is lost or degenerate; empty otherwise."""
    inlier_share: float
    """Share of depths seen in both, frame and sub-map, that agree."""
    visible_share: float
    """Share of the image that shows known parts of the sub-map."""
    cost: float
    """Mean robust cost per pixel."""
    colour_error: float
    """Standard deviation (from the median) of colour residuals, in units of full scale."""
    eigenvalues: NDArray[np.float64]
    """(6,) of the images' information relative to the motion prior's, ascending; directions in
    which nothing but noise spoke are near 0."""
    gain: float
    """Photometric correction: gain * frame + bias is as bright as the sub-map."""
    bias: float
    """In units of full scale."""
    renders: int
    """Renders of the sub-map that were needed."""
    stages_ms: dict[str, float]
    """Wall time by stage: pyramid, rotation, initialisation, render, refinement, verdict; or
    relocalisation alone where that found the pose."""

    @property
    def lost(self) -> bool:
        """Whether there is no measured pose."""
        return self.verdict == "lost"

    @property
    def condition_number(self) -> float:
        """Of the images' information in units of the motion prior: infinite where degenerate."""
        least, largest = float(self.eigenvalues[0]), float(self.eigenvalues[-1])
        return largest / least if least > 1e-9 * max(largest, 1e-300) else float("inf")

    @property
    def unseen_covariance(self) -> NDArray[np.float64] | None:
        """(6, 6) of a degenerate pose, which the motion prior determines in part; else None."""
        if self.verdict != "degenerate":
            return None
        return np.asarray(np.linalg.inv(self.information), np.float64)

    @property
    def total_ms(self) -> float:
        """Wall time of all stages."""
        return sum(self.stages_ms.values())


@dataclass(slots=True)
class StageClock:
    """Adds up the wall time of named stages."""

    stages_ms: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body of a with statement."""
        started = time.perf_counter()
        try:
            yield
        finally:
            elapsed_ms = 1e3 * (time.perf_counter() - started)
            self.stages_ms[name] = self.stages_ms.get(name, 0.0) + elapsed_ms
