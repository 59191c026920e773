"""Absolute trajectory error: RMSE of camera positions after one rigid alignment.

As in Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems" (IROS 2012), without
scale: RGB-D is metric.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core.data.association import associate
from magic_core.errors import InvalidInput
from magic_core.evaluation.trajectory import Trajectory
from magic_core.geometry.alignment import align_points

MAX_TIME_DIFFERENCE_S = 0.020


def ate_rmse(estimated: Trajectory, ground_truth: Trajectory) -> tuple[float, NDArray[np.float64]]:
    """(RMSE in metres, (4, 4) truth_from_estimated) of one trajectory.

    Raises InvalidInput where no pose of one has a pose of the other within 20 ms.
    """
    return joint_ate_rmse([(estimated, ground_truth)])


def joint_ate_rmse(
    pairs: Sequence[tuple[Trajectory, Trajectory]],
) -> tuple[float, NDArray[np.float64]]:
    """ATE of several (estimated, ground truth) trajectories under ONE alignment for all.

    What one alignment per agent would hide, agents misplaced relative to each other, counts here.
    """
    matched = [matched_positions(estimated, truth) for estimated, truth in pairs]
    estimated = np.concatenate([first for first, _ in matched] or [np.zeros((0, 3))])
    truth = np.concatenate([second for _, second in matched] or [np.zeros((0, 3))])
    if not len(estimated):
        raise InvalidInput.field(
            "ground_truth",
            "no pose within 20 ms of an estimated pose; check that both use one clock, in seconds",
        )
    truth_from_estimated = align_points(estimated, truth)
    aligned = estimated @ truth_from_estimated[:3, :3].T + truth_from_estimated[:3, 3]
    squared = ((aligned - truth) ** 2).sum(axis=1)
    return float(np.sqrt(squared.mean())), truth_from_estimated


def matched_positions(
    estimated: Trajectory, ground_truth: Trajectory
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (k, 3) and (k, 3) of the poses that are nearest in time."""
    pairs = associate(
        estimated.timestamps_s, ground_truth.timestamps_s, max_difference_s=MAX_TIME_DIFFERENCE_S
    )
    return estimated.positions[pairs[:, 0]], ground_truth.positions[pairs[:, 1]]
