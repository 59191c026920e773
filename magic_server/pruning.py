"""The newest solution without sub-maps that were deleted, until the graph is solved again."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core.geometry import se3
from magic_core.wire import convert, records


def without(
    snapshot: mapping_pb.PoseSnapshot,
    gone: Collection[str],
    *,
    accepted: int,
    kept: int,
    known_starts: Collection[str],
) -> mapping_pb.PoseSnapshot:
    """The snapshot as a new revision that knows nothing of the sub-maps in `gone`.

    A component that lost its oldest sub-map goes on under the name of the next, in that one's
    frame unless one of its sub-maps has a known start: then the frame is the user's and stays.
    `accepted` and `kept` count the loops that are left.
    """
    old = convert.snapshot_from_proto(snapshot)
    fixed = {old.poses[name].component for name in known_starts if name in old.poses}
    heirs: dict[str, records.CorrectedPose] = {}
    poses: dict[str, records.CorrectedPose] = {}
    for name, pose in old.poses.items():
        if name in gone:
            continue
        heir = heirs.setdefault(pose.component, pose)
        poses[name] = dataclasses.replace(pose, component=heir.submap)
        if heir.submap != pose.component and pose.component not in fixed:
            moved = se3.inverse(heir.world_from_anchor) @ pose.world_from_anchor
            poses[name] = dataclasses.replace(poses[name], world_from_anchor=moved)
    return convert.snapshot_to_proto(
        records.PoseSnapshot(
            session=old.session,
            revision=old.revision + 1,
            solved_at=convert.moment(time.time()),
            poses=poses,
            components=convert.components_of(poses.values()),
            loop_count=accepted,
            loops_kept=kept,
        )
    )
