"""From a live session to a run folder: trajectories, loops, components, pose graph, map."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

from magic_agent.client import MagicClient
from magic_core.data import FrameSource
from magic_core.evaluation import (
    Components,
    LoopRecord,
    PlacedAnchor,
    RunFolder,
    Trajectory,
    ground_truth_of,
)
from magic_core.evaluation.records import agent_of, index_of
from magic_core.wire import geometry, names, records

Edges = list[tuple[int, int, np.ndarray, np.ndarray]]


async def collect(client: MagicClient, session: str, folder: RunFolder) -> None:
    """Write what the server knows of a session: everything but the map."""
    snapshot = await client.get_corrected_poses(session)
    loops = await client.list_loops(session)
    folder.write_components(components_of(snapshot))
    folder.write_loops(loop_record(loop) for loop in loops.candidates)
    await _collect_trajectories(client, session, folder)
    await _collect_posegraph(client, snapshot, loops, folder)


async def collect_map(
    client: MagicClient,
    session: str,
    folder: RunFolder,
    *,
    timeout_s: float,
    progress: Callable[[float, str], None],
    coarse: bool = False,
) -> records.GlobalMapInfo:
    """Have the server merge the largest component and write the result as `map.ply`.

    With `coarse` the sub-maps are appended alone, and the file is `map_coarse.ply`.
    """
    path = folder.coarse_map_path if coarse else folder.map_path
    info = await client.build_global_map(
        session, coarse_only=coarse, timeout_s=timeout_s, progress=progress
    )
    _, ply = await client.download_global_map(info.name, format="ply")
    partial = path.with_suffix(".partial")
    await asyncio.to_thread(partial.write_bytes, ply)
    partial.replace(path)
    return info


def write_ground_truth(folder: RunFolder, sources: list[FrameSource]) -> None:
    """Write each source's ground truth where it has one. For evaluation alone."""
    for source in sources:
        poses = ground_truth_of(source)
        if poses is not None and len(poses):
            folder.write_trajectory(source.name, "ground_truth", poses)


def components_of(snapshot: records.PoseSnapshot) -> Components:
    """The snapshot as `components.json` keeps it."""
    members: dict[str, dict[str, list[int]]] = {info.id: {} for info in snapshot.components}
    for name, pose in snapshot.poses.items():
        agents = members.setdefault(pose.component, {})
        agents.setdefault(agent_of(name), []).append(index_of(name))
    return Components(
        revision=snapshot.revision,
        members={
            component: {agent: tuple(sorted(indices)) for agent, indices in agents.items()}
            for component, agents in members.items()
        },
        anchors={
            name: PlacedAnchor(pose.component, pose.world_from_anchor)
            for name, pose in snapshot.poses.items()
        },
    )


def loop_record(loop: records.LoopCandidate) -> LoopRecord:
    """A loop candidate as `loops.json` keeps it."""
    accepted = loop.verdict == "ACCEPTED" and loop.kept
    reason = loop.reason if loop.kept or loop.verdict != "ACCEPTED" else "SET_ASIDE_BY_SOLVER"
    return LoopRecord(
        source=loop.source,
        target=loop.target,
        similarity=loop.similarity,
        verdict="accepted" if accepted else "rejected",
        reason=reason,
        fitness=loop.fitness,
        rmse_m=loop.rmse_m,
        inliers=loop.inliers,
        overlap=loop.overlap,
        source_keyframe=loop.source_keyframe,
        target_keyframe=loop.target_keyframe,
    )


async def _collect_trajectories(client: MagicClient, session: str, folder: RunFolder) -> None:
    for info in await client.list_agents(session):
        agent = names.parse_agent(info.name)[1]
        parts = await client.get_trajectory(session, agent)
        frames = [frame for part in parts for frame in part.frames]
        poses = Trajectory.from_poses((f.timestamp_s, f.world_from_camera) for f in frames)
        if len(poses):
            folder.write_trajectory(agent, "corrected", poses)


async def _collect_posegraph(
    client: MagicClient,
    snapshot: records.PoseSnapshot,
    loops: records.LoopAnswer,
    folder: RunFolder,
) -> None:
    """Write `posegraph.g2o`: vertices in order of arrival, odometry edges, kept loops."""
    from magic_server.posegraph.g2o import write_g2o

    key_of = {name: key for key, name in enumerate(snapshot.poses)}
    edges: Edges = []
    for name, key in key_of.items():
        _, header = await client.get_submap(name)
        if header.HasField("odometry"):
            session, agent, _ = names.parse_submap(name)
            previous = names.submap_name(session, agent, header.odometry.previous_index)
            if previous in key_of:
                motion = geometry.pose_from_proto(header.odometry.previous_from_anchor)
                information = geometry.information_from_list(header.odometry.information)
                edges.append((key_of[previous], key, motion, information))
    for loop in loops.candidates:
        if loop.kept and loop.target_from_source is not None and loop.information is not None:
            ends = (key_of[loop.target], key_of[loop.source])
            edges.append((*ends, loop.target_from_source, loop.information))
    poses = {key_of[name]: pose.world_from_anchor for name, pose in snapshot.poses.items()}
    await asyncio.to_thread(write_g2o, folder.posegraph_path, poses, edges)
