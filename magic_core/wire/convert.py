"""Records to messages and back. Each pair of functions is the inverse of the other."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np
from google.protobuf.timestamp_pb2 import Timestamp
from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import session_service_pb2 as session_pb

from magic_core.gaussians.region import Region
from magic_core.wire import geometry, records

_K = TypeVar("_K")
_V = TypeVar("_V")

_VERDICTS: dict[records.Verdict, mapping_pb.LoopVerdict.ValueType] = {
    "SIMILAR": mapping_pb.LOOP_VERDICT_UNSPECIFIED,
    "PENDING": mapping_pb.LOOP_VERDICT_PENDING,
    "ACCEPTED": mapping_pb.LOOP_VERDICT_ACCEPTED,
    "REJECTED": mapping_pb.LOOP_VERDICT_REJECTED,
}
_OPERATION_STATES: dict[records.OperationState, map_pb.OperationState.ValueType] = {
    "PENDING": map_pb.OPERATION_STATE_PENDING,
    "RUNNING": map_pb.OPERATION_STATE_RUNNING,
    "SUCCEEDED": map_pb.OPERATION_STATE_SUCCEEDED,
    "FAILED": map_pb.OPERATION_STATE_FAILED,
}
_AGENT_STATES: dict[records.AgentState, session_pb.AgentState.ValueType] = {
    "ACTIVE": session_pb.AGENT_STATE_ACTIVE,
    "FINISHED": session_pb.AGENT_STATE_FINISHED,
}
_MAP_FORMATS: dict[records.MapFormat, map_pb.MapFormat.ValueType] = {
    "ply": map_pb.MAP_FORMAT_PLY,
    "lossless": map_pb.MAP_FORMAT_LOSSLESS,
    "compact": map_pb.MAP_FORMAT_COMPACT,
}


def _key_of(table: dict[_K, _V], value: _V, default: _K) -> _K:
    return next((key for key, number in table.items() if number == value), default)


def moment(seconds: float) -> datetime:
    """Seconds since 1970 as UTC time."""
    return datetime.fromtimestamp(seconds, UTC)


def timestamp_to_proto(moment: datetime) -> Timestamp:
    """A UTC time as its message."""
    message = Timestamp()
    message.FromDatetime(moment)
    return message


def timestamp_from_proto(message: Timestamp) -> datetime:
    """The UTC time of a message."""
    return message.ToDatetime(UTC)


def map_format_to_proto(format_: records.MapFormat) -> map_pb.MapFormat.ValueType:
    """A file format as its number."""
    return _MAP_FORMATS[format_]


def map_format_from_proto(number: map_pb.MapFormat.ValueType) -> records.MapFormat:
    """The file format of a number; PLY when unspecified."""
    return _key_of(_MAP_FORMATS, number, "ply")


def loop_to_proto(loop: records.LoopCandidate) -> mapping_pb.LoopCandidate:
    """A loop candidate as its message."""
    message = mapping_pb.LoopCandidate(
        source=loop.source,
        target=loop.target,
        similarity=loop.similarity,
        verdict=_VERDICTS[loop.verdict],
        reason=loop.reason,
        fitness=loop.fitness,
        rmse_m=loop.rmse_m,
        inliers=loop.inliers,
        overlap=loop.overlap,
        verify_seconds=loop.verify_seconds,
        kept=loop.kept,
        source_keyframe=loop.source_keyframe,
        target_keyframe=loop.target_keyframe,
    )
    if loop.target_from_source is not None:
        message.target_from_source.CopyFrom(geometry.pose_to_proto(loop.target_from_source))
    if loop.information is not None:
        message.information.extend(geometry.information_to_list(loop.information))
    return message


def loop_from_proto(message: mapping_pb.LoopCandidate) -> records.LoopCandidate:
    """The loop candidate of a message."""
    verified = message.HasField("target_from_source")
    values = message.information
    return records.LoopCandidate(
        source=message.source,
        target=message.target,
        similarity=message.similarity,
        verdict=_key_of(_VERDICTS, message.verdict, "SIMILAR"),
        reason=message.reason,
        target_from_source=(
            geometry.pose_from_proto(message.target_from_source) if verified else None
        ),
        information=geometry.information_from_list(values) if values else None,
        fitness=message.fitness,
        rmse_m=message.rmse_m,
        inliers=message.inliers,
        overlap=message.overlap,
        verify_seconds=message.verify_seconds,
        kept=message.kept,
        source_keyframe=message.source_keyframe,
        target_keyframe=message.target_keyframe,
    )


def snapshot_to_proto(snapshot: records.PoseSnapshot) -> mapping_pb.PoseSnapshot:
    """A solution as its message. Slow for thousands of poses: build it off the event loop."""
    solved_at = None if snapshot.solved_at is None else timestamp_to_proto(snapshot.solved_at)
    return mapping_pb.PoseSnapshot(
        session=snapshot.session,
        revision=snapshot.revision,
        solved_at=solved_at,
        poses=[_pose_to_proto(pose) for pose in snapshot.poses.values()],
        components=[
            mapping_pb.Component(id=c.id, submap_count=c.submap_count, agents=c.agents)
            for c in snapshot.components
        ],
        loop_count=snapshot.loop_count,
        loops_kept=snapshot.loops_kept,
    )


def snapshot_from_proto(message: mapping_pb.PoseSnapshot) -> records.PoseSnapshot:
    """The solution of a message."""
    rows = geometry.pose_rows(pose.world_from_anchor for pose in message.poses)
    transforms = geometry.transforms_of_rows(rows)
    solved = message.HasField("solved_at")
    return records.PoseSnapshot(
        session=message.session,
        revision=message.revision,
        solved_at=timestamp_from_proto(message.solved_at) if solved else None,
        poses={
            pose.submap: records.CorrectedPose(pose.submap, pose.component, transform)
            for pose, transform in zip(message.poses, transforms, strict=True)
        },
        components=tuple(
            records.ComponentInfo(c.id, c.submap_count, tuple(c.agents)) for c in message.components
        ),
        loop_count=message.loop_count,
        loops_kept=message.loops_kept,
    )


def snapshot_of_agent(message: mapping_pb.PoseSnapshot, agent: str) -> mapping_pb.PoseSnapshot:
    """The same solution with the poses of one agent only; `agent` is its resource name."""
    chosen = mapping_pb.PoseSnapshot()
    chosen.CopyFrom(message)
    del chosen.poses[:]
    prefix = f"{agent}/"
    chosen.poses.extend(pose for pose in message.poses if pose.submap.startswith(prefix))
    return chosen


def components_of(poses: Iterable[records.CorrectedPose]) -> tuple[records.ComponentInfo, ...]:
    """The components that poses lie in, largest first, then by id."""
    members: dict[str, list[str]] = {}
    for pose in poses:
        members.setdefault(pose.component, []).append(pose.submap)
    found = []
    for component, submaps in members.items():
        agents = dict.fromkeys(name.rpartition("/submaps/")[0] for name in submaps)
        found.append(records.ComponentInfo(component, len(submaps), tuple(agents)))
    return tuple(sorted(found, key=lambda c: (-c.submap_count, c.id)))


def trajectory_part_to_proto(part: records.TrajectoryPart) -> mapping_pb.GetTrajectoryResponse:
    """The corrected frames of a sub-map as their message."""
    return mapping_pb.GetTrajectoryResponse(
        submap=part.submap,
        component=part.component,
        revision=part.revision,
        frames=[
            mapping_pb.CorrectedFrame(
                frame_index=frame.frame_index,
                timestamp_s=frame.timestamp_s,
                world_from_camera=geometry.pose_to_proto(frame.world_from_camera),
                lost=frame.lost,
            )
            for frame in part.frames
        ],
    )


def trajectory_part_from_proto(message: mapping_pb.GetTrajectoryResponse) -> records.TrajectoryPart:
    """The corrected frames of a message."""
    rows = geometry.pose_rows(frame.world_from_camera for frame in message.frames)
    transforms = geometry.transforms_of_rows(rows)
    frames = tuple(
        records.CorrectedFrame(frame.frame_index, frame.timestamp_s, transform, frame.lost)
        for frame, transform in zip(message.frames, transforms, strict=True)
    )
    return records.TrajectoryPart(message.submap, message.component, message.revision, frames)


def map_to_proto(info: records.GlobalMapInfo) -> map_pb.GlobalMap:
    """A map's description as its message."""
    return map_pb.GlobalMap(
        name=info.name,
        component=info.component,
        revision=info.revision,
        submaps=info.submaps,
        gaussian_count=info.gaussian_count,
        created_at=timestamp_to_proto(info.created_at),
    )


def map_from_proto(message: map_pb.GlobalMap) -> records.GlobalMapInfo:
    """The description of a map."""
    return records.GlobalMapInfo(
        name=message.name,
        component=message.component,
        revision=message.revision,
        submaps=tuple(message.submaps),
        gaussian_count=message.gaussian_count,
        created_at=timestamp_from_proto(message.created_at),
    )


def region_to_proto(region: Region) -> map_pb.Region:
    """A box as its message."""
    (low_x, low_y, low_z), (high_x, high_y, high_z) = region.low, region.high
    return map_pb.Region(
        low_x=low_x, low_y=low_y, low_z=low_z, high_x=high_x, high_y=high_y, high_z=high_z
    )


def region_from_proto(message: map_pb.Region) -> Region:
    """The box of a message; InvalidInput for NaN and for one that holds nothing."""
    return Region(
        (message.low_x, message.low_y, message.low_z),
        (message.high_x, message.high_y, message.high_z),
    )


def part_to_proto(part: records.MapPart) -> map_pb.MapPart:
    """What a file holds of a map, as its message."""
    return map_pb.MapPart(
        region=None if part.region is None else region_to_proto(part.region),
        max_gaussians=part.max_gaussians,
        gaussian_count=part.gaussian_count,
        full_gaussian_count=part.full_gaussian_count,
    )


def part_from_proto(message: map_pb.MapPart) -> records.MapPart:
    """What a file holds of a map."""
    return records.MapPart(
        region=region_from_proto(message.region) if message.HasField("region") else None,
        max_gaussians=message.max_gaussians,
        gaussian_count=message.gaussian_count,
        full_gaussian_count=message.full_gaussian_count,
    )


def operation_to_proto(status: records.OperationStatus) -> map_pb.Operation:
    """An operation as its message."""
    error = None
    if status.error is not None:
        error = map_pb.OperationError(
            code=status.error.code, reason=status.error.reason, message=status.error.message
        )
    return map_pb.Operation(
        name=status.name,
        state=_OPERATION_STATES[status.state],
        progress=status.progress,
        stage=status.stage,
        created_at=timestamp_to_proto(status.created_at),
        updated_at=timestamp_to_proto(status.updated_at),
        error=error,
        result=None if status.result is None else map_to_proto(status.result),
    )


def operation_from_proto(message: map_pb.Operation) -> records.OperationStatus:
    """The operation of a message."""
    error = None
    if message.HasField("error"):
        fields = message.error
        error = records.OperationError(fields.code, fields.reason, fields.message)
    return records.OperationStatus(
        name=message.name,
        state=_key_of(_OPERATION_STATES, message.state, "PENDING"),
        progress=message.progress,
        stage=message.stage,
        created_at=timestamp_from_proto(message.created_at),
        updated_at=timestamp_from_proto(message.updated_at),
        error=error,
        result=map_from_proto(message.result) if message.HasField("result") else None,
    )


def session_to_proto(info: records.SessionInfo) -> session_pb.Session:
    """A session as its message."""
    return session_pb.Session(
        name=info.name,
        created_at=timestamp_to_proto(info.created_at),
        descriptor_model_id=info.descriptor_model_id,
        descriptor_dimension=info.descriptor_dimension,
        agent_count=info.agent_count,
        submap_count=info.submap_count,
        stored_bytes=info.stored_bytes,
        revision=info.revision,
        pending_loops=info.pending_loops,
    )


def session_from_proto(message: session_pb.Session) -> records.SessionInfo:
    """The session of a message."""
    return records.SessionInfo(
        name=message.name,
        created_at=timestamp_from_proto(message.created_at),
        descriptor_model_id=message.descriptor_model_id,
        descriptor_dimension=message.descriptor_dimension,
        agent_count=message.agent_count,
        submap_count=message.submap_count,
        stored_bytes=message.stored_bytes,
        revision=message.revision,
        pending_loops=message.pending_loops,
    )


def agent_to_proto(info: records.AgentInfo) -> session_pb.Agent:
    """An agent as its message."""
    return session_pb.Agent(
        name=info.name,
        state=_AGENT_STATES[info.state],
        registered_at=timestamp_to_proto(info.registered_at),
        last_seen_at=timestamp_to_proto(info.last_seen_at),
        submap_count=info.submap_count,
        next_submap_index=info.next_submap_index,
    )


def agent_from_proto(message: session_pb.Agent) -> records.AgentInfo:
    """The agent of a message."""
    return records.AgentInfo(
        name=message.name,
        state=_key_of(_AGENT_STATES, message.state, "ACTIVE"),
        registered_at=timestamp_from_proto(message.registered_at),
        last_seen_at=timestamp_from_proto(message.last_seen_at),
        submap_count=message.submap_count,
        next_submap_index=message.next_submap_index,
    )


def submap_info_to_proto(info: records.SubmapInfo) -> session_pb.Submap:
    """A sub-map's summary as its message."""
    return session_pb.Submap(
        name=info.name,
        received_at=timestamp_to_proto(info.received_at),
        first_timestamp_s=info.first_timestamp_s,
        last_timestamp_s=info.last_timestamp_s,
        frame_count=info.frame_count,
        keyframe_count=info.keyframe_count,
        gaussian_count=info.gaussian_count,
        stored_bytes=info.stored_bytes,
    )


def submap_info_from_proto(message: session_pb.Submap) -> records.SubmapInfo:
    """The summary of a message."""
    return records.SubmapInfo(
        name=message.name,
        received_at=timestamp_from_proto(message.received_at),
        first_timestamp_s=message.first_timestamp_s,
        last_timestamp_s=message.last_timestamp_s,
        frame_count=message.frame_count,
        keyframe_count=message.keyframe_count,
        gaussian_count=message.gaussian_count,
        stored_bytes=message.stored_bytes,
    )


def localization_from_proto(message: mapping_pb.LocalizeResponse) -> records.Localization:
    """Where an image was taken."""
    return records.Localization(
        world_from_camera=geometry.pose_from_proto(message.world_from_camera),
        component=message.component,
        revision=message.revision,
        submap=message.submap,
        anchor_from_camera=geometry.pose_from_proto(message.anchor_from_camera),
        fitness=message.fitness,
        rmse_m=message.rmse_m,
        inliers=message.inliers,
        overlap=message.overlap,
        similarity=message.similarity,
        confidence=message.confidence,
        information=geometry.information_from_list(message.information),
    )


def localization_to_proto(found: records.Localization) -> mapping_pb.LocalizeResponse:
    """Where an image was taken as its message."""
    return mapping_pb.LocalizeResponse(
        world_from_camera=geometry.pose_to_proto(found.world_from_camera),
        component=found.component,
        revision=found.revision,
        submap=found.submap,
        anchor_from_camera=geometry.pose_to_proto(found.anchor_from_camera),
        fitness=found.fitness,
        rmse_m=found.rmse_m,
        inliers=found.inliers,
        overlap=found.overlap,
        similarity=found.similarity,
        confidence=found.confidence,
        information=geometry.information_to_list(found.information),
    )


def _pose_to_proto(pose: records.CorrectedPose) -> mapping_pb.CorrectedPose:
    return mapping_pb.CorrectedPose(
        submap=pose.submap,
        component=pose.component,
        world_from_anchor=geometry.pose_to_proto(np.asarray(pose.world_from_anchor)),
    )
