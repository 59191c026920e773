"""Relative pose error: how much the motion over a fixed time differs from the true motion.

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems" (IROS 2012). It needs no
alignment and measures drift, where the absolute error measures consistency.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magic_core.data.association import associate
from magic_core.errors import InvalidInput
from magic_core.evaluation.ate import MAX_TIME_DIFFERENCE_S
from magic_core.evaluation.trajectory import Trajectory
from magic_core.geometry import se3


@dataclass(frozen=True, slots=True)
class RelativePoseError:
    """RMSE over all pairs of frames that lie one interval apart."""

    translation_m: float
    rotation_rad: float
    pairs: int


def relative_pose_error(
    estimated: Trajectory, ground_truth: Trajectory, *, interval_s: float = 1.0
) -> RelativePoseError:
    """RPE over motions of `interval_s` seconds.

    Raises InvalidInput where no two frames with ground truth lie so far apart.
    """
    matched = associate(
        estimated.timestamps_s, ground_truth.timestamps_s, max_difference_s=MAX_TIME_DIFFERENCE_S
    )
    times = estimated.timestamps_s[matched[:, 0]]
    first, second = _pairs(times, interval_s)
    if not len(first):
        raise InvalidInput.field(
            "ground_truth", f"no two frames with ground truth lie {interval_s:g} s apart"
        )
    ours = estimated.world_from_camera[matched[:, 0]]
    truth = ground_truth.world_from_camera[matched[:, 1]]
    error = se3.inverse(se3.inverse(truth[first]) @ truth[second]) @ (
        se3.inverse(ours[first]) @ ours[second]
    )
    cosine = np.clip((np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return RelativePoseError(
        translation_m=float(np.sqrt((error[:, :3, 3] ** 2).sum(axis=1).mean())),
        rotation_rad=float(np.sqrt((np.arccos(cosine) ** 2).mean())),
        pairs=len(first),
    )


def _pairs(times: np.ndarray, interval_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Each frame with the one nearest to an interval later, within the tolerance of association."""
    if len(times) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    wanted = times + interval_s
    later = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    later -= wanted - times[later - 1] < times[later] - wanted
    fits = np.abs(times[later] - wanted) <= MAX_TIME_DIFFERENCE_S
    return np.flatnonzero(fits), later[fits]
