"""Track and map one recording, without any server, and say how far off the trajectory is.

python examples/01_single_agent.py                        # a flat that is generated here
python examples/01_single_agent.py ~/recordings/office    # your own data
"""

from __future__ import annotations

import sys

import numpy as np

from magic_agent.places import load_descriptor_model
from magic_agent.slam import LocalSlam
from magic_agent.slam_config import SlamConfig
from magic_core.data import open_dataset
from magic_core.evaluation import Trajectory, ate_rmse, ground_truth_of

DEFAULT = "synthetic://flat?agents=1&frames=60&width=160&height=120&detail=draft"


def main(dataset: str = DEFAULT) -> float | None:
    """Run it; returns the ATE RMSE in metres where the recording has ground truth."""
    source = open_dataset(dataset)[0]
    describe = load_descriptor_model().describe
    slam = LocalSlam(source.camera, SlamConfig(), session="example", agent="me", describe=describe)
    submaps = []
    for frame in source:
        submaps.append(slam.process(frame).finished)
    submaps = [submap for submap in [*submaps, slam.finish()] if submap is not None]

    # Every sub-map is relative to its own anchor; the odometry edges chain them together.
    poses, world_from_anchor = [], np.eye(4)
    for submap in submaps:
        if submap.odometry is not None:
            world_from_anchor = world_from_anchor @ submap.odometry.previous_from_anchor
        for tracked in submap.trajectory:
            poses.append((tracked.timestamp_s, world_from_anchor @ tracked.anchor_from_camera))
    gaussians = sum(len(submap.gaussians) for submap in submaps)
    print(f"{len(poses)} frames, {len(submaps)} sub-maps, {gaussians:,} Gaussians")

    truth = ground_truth_of(source)
    if truth is None:
        return None
    error_m, _ = ate_rmse(Trajectory.from_poses(poses), truth)
    print(f"ATE RMSE {100 * error_m:.2f} cm")
    return error_m


if __name__ == "__main__":
    main(*sys.argv[1:])
