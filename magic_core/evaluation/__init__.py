"""Trajectories, errors, image metrics, run folders and reports.

What needs images, the map or matplotlib is imported when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from magic_core.evaluation.ate import ate_rmse, joint_ate_rmse
from magic_core.evaluation.records import (
    AgentReport,
    Components,
    LoopRecord,
    PlacedAnchor,
    WireBytes,
)
from magic_core.evaluation.run_folder import RunFolder
from magic_core.evaluation.trajectory import (
    Trajectory,
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)

if TYPE_CHECKING:
    from magic_core.evaluation.accuracy import ground_truth_of, measure_trajectories
    from magic_core.evaluation.evaluate import evaluate_run
    from magic_core.evaluation.image_metrics import depth_l1, ms_ssim, psnr, ssim
    from magic_core.evaluation.lpips import Lpips
    from magic_core.evaluation.report import write_report
    from magic_core.evaluation.rpe import relative_pose_error

_HOMES = {
    "Lpips": "lpips",
    "depth_l1": "image_metrics",
    "evaluate_run": "evaluate",
    "ground_truth_of": "accuracy",
    "measure_trajectories": "accuracy",
    "ms_ssim": "image_metrics",
    "psnr": "image_metrics",
    "relative_pose_error": "rpe",
    "ssim": "image_metrics",
    "write_report": "report",
}

__all__ = [
    "AgentReport",
    "Components",
    "LoopRecord",
    "Lpips",
    "PlacedAnchor",
    "RunFolder",
    "Trajectory",
    "WireBytes",
    "ate_rmse",
    "depth_l1",
    "evaluate_run",
    "ground_truth_of",
    "joint_ate_rmse",
    "measure_trajectories",
    "ms_ssim",
    "psnr",
    "read_kitti",
    "read_tum",
    "relative_pose_error",
    "ssim",
    "write_kitti",
    "write_report",
    "write_tum",
]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
