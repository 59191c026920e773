"""Trajectories, errors, image metrics, run folders and reports."""

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

__all__ = [
    "AgentReport",
    "Components",
    "LoopRecord",
    "PlacedAnchor",
    "RunFolder",
    "Trajectory",
    "WireBytes",
    "ate_rmse",
    "joint_ate_rmse",
    "read_kitti",
    "read_tum",
    "write_kitti",
    "write_tum",
]
