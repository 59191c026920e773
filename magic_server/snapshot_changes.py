"""Pose graph solutions as a whole and the changes to it: PoseSnapshots with changed poses only."""

from __future__ import annotations

from collections.abc import Iterable

from magicslam.v1 import mapping_service_pb2 as mapping_pb


def copied(snapshot: mapping_pb.PoseSnapshot) -> mapping_pb.PoseSnapshot:
    """A copy that may be changed."""
    copy = mapping_pb.PoseSnapshot()
    copy.CopyFrom(snapshot)
    return copy


def copy_head(source: mapping_pb.PoseSnapshot, target: mapping_pb.PoseSnapshot) -> None:
    """Everything but the poses."""
    target.session = source.session
    target.revision = source.revision
    target.ClearField("solved_at")
    if source.HasField("solved_at"):
        target.solved_at.CopyFrom(source.solved_at)
    del target.components[:]
    target.components.extend(source.components)
    target.loop_count, target.loops_kept = source.loop_count, source.loops_kept


def merge(
    whole: mapping_pb.PoseSnapshot, change: mapping_pb.PoseSnapshot, row: dict[str, int]
) -> list[str]:
    """Write a change into a solution whose sub-maps lie in `row`; returns new names, in order.

    `row` is left as it is.
    """
    copy_head(change, whole)
    new = []
    for pose in change.poses:
        if pose.submap in row:
            whole.poses[row[pose.submap]].CopyFrom(pose)
        else:
            whole.poses.append(pose)
            new.append(pose.submap)
    return new


def merged_bytes(whole: bytes, changes: Iterable[bytes]) -> bytes:
    """A stored solution with the stored changes to it, serialised as they are."""
    snapshot = mapping_pb.PoseSnapshot.FromString(whole)
    row = {pose.submap: number for number, pose in enumerate(snapshot.poses)}
    for change in changes:
        for name in merge(snapshot, mapping_pb.PoseSnapshot.FromString(change), row):
            row[name] = len(row)
    return snapshot.SerializeToString()
