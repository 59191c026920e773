"""Where corrected sub-maps meet their neighbours, for the frames between the anchors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import submap_pb2
from numpy.typing import NDArray

from magic_core.geometry.seams import Seams, even_shares, seams_between
from magic_core.submap import OdometryEdge
from magic_core.wire import geometry, names

Pose = NDArray[np.float64]


def seams_of(
    poses: Iterable[mapping_pb.CorrectedPose], odometry_of: Callable[[str], OdometryEdge | None]
) -> dict[str, Seams]:
    """The seams of every sub-map by resource name, all poses of one revision."""
    anchors = {pose.submap: geometry.pose_from_proto(pose.world_from_anchor) for pose in poses}
    return seams_of_anchors(anchors, odometry_of)


def seams_of_anchors(
    anchors: Mapping[str, Pose], odometry_of: Callable[[str], OdometryEdge | None]
) -> dict[str, Seams]:
    """The same from each sub-map's world_from_anchor (4, 4).

    A sub-map that was tracked on from one that has been deleted has no seam there.
    """
    odometry: dict[str, tuple[str, Pose]] = {}
    for name in anchors:
        edge = odometry_of(name)
        if edge is not None:
            session, agent, _ = names.parse_submap(name)
            previous = names.submap_name(session, agent, edge.previous_index)
            odometry[name] = previous, edge.previous_from_anchor
    return seams_between(anchors, odometry)


def shares_of(trajectory: Iterable[submap_pb2.TrackedFrame]) -> dict[int, float]:
    """How far along its sub-map each frame is, by frame index: 0 at the anchor, 1 at the next."""
    indices = [frame.frame_index for frame in trajectory]
    return dict(zip(indices, even_shares(len(indices)).tolist(), strict=True))
