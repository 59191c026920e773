"""How exact a run's trajectories are."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.data import FrameSource
from magic_core.errors import InvalidInput, NotFound
from magic_core.evaluation.ate import ate_rmse, joint_ate_rmse
from magic_core.evaluation.records import Components
from magic_core.evaluation.rpe import RelativePoseError, relative_pose_error
from magic_core.evaluation.run_folder import RunFolder, TrajectoryKind
from magic_core.evaluation.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class TrajectoryAccuracy:
    """ATE RMSE in metres, and RPE; agents without ground truth are absent."""

    corrected_m: dict[str, float]
    """Per agent, each under its own alignment."""
    tracked_m: dict[str, float]
    """The same before correction: odometry alone."""
    joint_m: float | None
    """All agents of the largest component under one alignment."""
    truth_from_world: NDArray[np.float64] | None
    """That alignment, (4, 4)."""
    joint_agents: tuple[str, ...]
    """The agents it covers."""
    relative: dict[str, RelativePoseError]
    """RPE over one second, per agent, after correction."""
    relative_tracked: dict[str, RelativePoseError]
    """The same of odometry alone."""


def ground_truth_of(source: FrameSource) -> Trajectory | None:
    """The ground truth of a source where it has one; frames are only read if they must be."""
    timed_poses: Callable[[], list] | None = getattr(source, "timed_poses", None)
    if timed_poses is not None:
        pairs = timed_poses()
    else:
        pairs = [(frame.timestamp_s, frame.world_from_camera) for frame in source]
    known = [(time, pose) for time, pose in pairs if pose is not None]
    return Trajectory.from_poses(known) if known else None


def measure_trajectories(run: RunFolder) -> TrajectoryAccuracy:
    """ATE of every agent and of the largest component, from the run folder's files."""
    main = main_component_trajectories(run)
    pairs = {}
    for agent, estimated in main.items():
        if run.has_trajectory(agent, "ground_truth"):
            pairs[agent] = (estimated, run.read_trajectory(agent, "ground_truth"))
    pairs = {agent: pair for agent, pair in pairs.items() if _overlap(*pair)}
    joint, alignment = (None, None) if not pairs else joint_ate_rmse(list(pairs.values()))
    corrected, tracked = _pairs(run, "corrected"), _pairs(run, "tracked")
    return TrajectoryAccuracy(
        corrected_m={agent: ate_rmse(*pair)[0] for agent, pair in corrected.items()},
        tracked_m={agent: ate_rmse(*pair)[0] for agent, pair in tracked.items()},
        joint_m=joint,
        truth_from_world=alignment,
        joint_agents=tuple(pairs),
        relative=_relative(corrected),
        relative_tracked=_relative(tracked),
    )


def main_component_trajectories(run: RunFolder) -> dict[str, Trajectory]:
    """Corrected poses that live in the frame of the largest component, by agent.

    That is the frame of the merged map. Without components.json every agent is taken to be in it.
    """
    components = _components(run)
    main = components.largest() if components else None
    result = {}
    for agent in run.agents():
        if not run.has_trajectory(agent, "corrected"):
            continue
        trajectory = run.read_trajectory(agent, "corrected")
        if components and main is not None:
            trajectory = trajectory.select(_in_component(run, components, main, agent, trajectory))
        if len(trajectory):
            result[agent] = trajectory
    return result


def _in_component(
    run: RunFolder, components: Components, component: str, agent: str, trajectory: Trajectory
) -> NDArray[np.bool_]:
    """(n,) which poses of a trajectory belong to sub-maps of a component."""
    whole = np.full(len(trajectory), components.main_component_of(agent) == component)
    indices = components.members.get(component, {}).get(agent, ())
    held = sum(len(agents.get(agent, ())) for agents in components.members.values())
    if len(indices) == held or not indices:
        return whole
    try:
        starts = run.read_agent_report(agent).submap_first_frames
        tracked = run.read_trajectory(agent, "tracked")
    except NotFound:
        return whole
    if not starts:
        return whole
    # Sub-maps are spans of frames; the tracked trajectory has one line for each of those frames.
    begins = np.array([start - starts[0] for start in starts])
    frame = np.searchsorted(tracked.timestamps_s, trajectory.timestamps_s - 1e-4)
    submap = np.searchsorted(begins, frame, side="right") - 1
    return np.isin(submap, indices)


def _pairs(run: RunFolder, kind: TrajectoryKind) -> dict[str, tuple[Trajectory, Trajectory]]:
    """Each agent's estimate and truth, where they overlap in time."""
    result = {}
    for agent in run.agents():
        if run.has_trajectory(agent, kind) and run.has_trajectory(agent, "ground_truth"):
            estimated = run.read_trajectory(agent, kind)
            if kind == "corrected":
                estimated = _own_component(run, agent, estimated)
            pair = (estimated, run.read_trajectory(agent, "ground_truth"))
            if _overlap(*pair):
                result[agent] = pair
    return result


def _relative(
    pairs: dict[str, tuple[Trajectory, Trajectory]],
) -> dict[str, RelativePoseError]:
    """RPE of each agent whose recording is long enough for it."""
    result = {}
    for agent, pair in pairs.items():
        with contextlib.suppress(InvalidInput):
            result[agent] = relative_pose_error(*pair)
    return result


def _own_component(run: RunFolder, agent: str, trajectory: Trajectory) -> Trajectory:
    """The poses in the component that holds most of the agent: one frame, one alignment."""
    components = _components(run)
    name = components.main_component_of(agent) if components else None
    if components is None or name is None:
        return trajectory
    return trajectory.select(_in_component(run, components, name, agent, trajectory))


def _components(run: RunFolder) -> Components | None:
    return run.read_components() if run.components_path.is_file() else None


def _overlap(estimated: Trajectory, truth: Trajectory) -> bool:
    try:
        ate_rmse(estimated, truth)
    except InvalidInput:
        return False
    return True
