"""What the viewer keeps of a session: sub-maps in their own frames, and one pose for each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.geometry.seams import Seams, seams_between
from magic_core.submap import Keyframe, Submap
from magic_core.wire import names
from magic_core.wire.records import AgentInfo, LoopCandidate, PoseSnapshot

Pose = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SubmapView:
    """One sub-map as it is drawn; nothing in it changes when the pose graph moves."""

    name: str
    """Resource name."""
    agent: str
    index: int
    camera: Camera
    cloud: GaussianCloud  # anchor frame
    path: NDArray[np.float64]  # (n, 4, 4) anchor_from_camera of its frames
    times_s: tuple[float, ...]
    """Their timestamps."""
    frame_indices: tuple[int, ...]
    keyframes: tuple[Keyframe, ...]
    previous: tuple[int, Pose] | None
    """Index of the sub-map before, and previous_from_anchor as it was tracked."""
    extent: NDArray[np.float64]  # (k, 3) anchor frame
    """How far it reaches; see `extent_of`."""

    @classmethod
    def of(cls, submap: Submap) -> SubmapView:
        """From a sub-map as downloaded."""
        edge = submap.odometry
        path = np.stack([frame.anchor_from_camera for frame in submap.trajectory])
        return cls(
            name=submap.name,
            agent=submap.agent,
            index=submap.index,
            camera=submap.camera,
            cloud=submap.gaussians,
            path=path,
            times_s=tuple(frame.timestamp_s for frame in submap.trajectory),
            frame_indices=tuple(frame.frame_index for frame in submap.trajectory),
            keyframes=submap.keyframes,
            previous=(edge.previous_index, edge.previous_from_anchor) if edge else None,
            extent=extent_of(submap.gaussians, path),
        )

    def spread(self, seams: Seams) -> NDArray[np.float64]:
        """(n, 4, 4) anchor_from_camera of its frames, with what its seams ask of them."""
        return seams.spread(self.path)


@dataclass(slots=True)
class SessionView:
    """The newest state of one session."""

    session: str
    submaps: dict[str, SubmapView] = field(default_factory=dict)
    """By resource name, in order of arrival."""
    snapshot: PoseSnapshot | None = None
    loops: tuple[LoopCandidate, ...] = ()
    agents: tuple[AgentInfo, ...] = ()
    merged: dict[str, GaussianCloud] = field(default_factory=dict)
    """Component -> its newest merged map, world frame of the component."""

    def world_from_anchor(self) -> dict[str, Pose]:
        """The corrected pose of every known sub-map; each component stands beside the one before.

        Components have no common frame, so the picture sets them apart along x.
        """
        if self.snapshot is None:
            return {}
        offsets = self._offsets()
        return {
            name: offsets[pose.component] @ pose.world_from_anchor
            for name, pose in self.snapshot.poses.items()
            if name in self.submaps
        }

    def component_offset(self, component: str) -> Pose:
        """Where a component's world frame stands in the picture."""
        return self._offsets().get(component, se3.identity())

    def tracked(self) -> dict[str, Pose]:
        """The poses without any correction: each chain of odometry from its first sub-map on."""
        corrected = self.world_from_anchor()
        found: dict[str, Pose] = {}
        for name, view in self.submaps.items():
            if name not in corrected:
                continue
            before = None
            if view.previous is not None:
                before = found.get(_sibling(name, view.previous[0]))
            found[name] = (
                corrected[name] if before is None or view.previous is None
                else before @ view.previous[1]
            )  # fmt: skip
        return found

    def world_from_cameras(self, agent: str, anchors: dict[str, Pose]) -> list[NDArray[np.float64]]:
        """(n, 4, 4) poses of the frames of each sub-map of an agent, in order."""
        mine = [v for v in self.submaps.values() if v.agent == agent and v.name in anchors]
        seams = self._seams(mine, anchors)
        return [anchors[view.name] @ view.spread(seams[view.name]) for view in mine]

    def world_from_keyframe(self, submap: str, keyframe: int) -> Pose:
        """The corrected pose (4, 4) of a keyframe in its component's own world frame.

        The merged map was made with its seams spread; sub-maps that lie as they were sent are seen
        best from where each was tracked.
        """
        assert self.snapshot is not None
        view, pose = self.submaps[submap], self.snapshot.poses[submap]
        if pose.component not in self.merged:
            return pose.world_from_anchor @ view.keyframes[keyframe].anchor_from_camera
        anchors = {
            name: pose.world_from_anchor
            for name, pose in self.snapshot.poses.items()
            if name in self.submaps and self.submaps[name].agent == view.agent
        }
        seams = self._seams([self.submaps[name] for name in anchors], anchors)[submap]
        frames = anchors[submap] @ view.spread(seams)
        return frames[view.frame_indices.index(view.keyframes[keyframe].frame_index)]

    def _seams(self, views: list[SubmapView], anchors: dict[str, Pose]) -> dict[str, Seams]:
        """How sub-maps, of one agent, meet each other."""
        odometry = {
            view.name: (_sibling(view.name, view.previous[0]), view.previous[1])
            for view in views
            if view.previous is not None
        }
        return seams_between({view.name: anchors[view.name] for view in views}, odometry)

    def camera_positions(self, component: str) -> NDArray[np.float64]:
        """(k, 3) where the cameras of a component's frames stood, in its own world frame."""
        assert self.snapshot is not None
        parts = [
            (pose.world_from_anchor @ self.submaps[name].path)[:, :3, 3]
            for name, pose in self.snapshot.poses.items()
            if pose.component == component and name in self.submaps
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))

    def agent_names(self) -> tuple[str, ...]:
        """Agents that have sent something, sorted."""
        return tuple(sorted({view.agent for view in self.submaps.values()}))

    def _offsets(self) -> dict[str, Pose]:
        assert self.snapshot is not None
        offsets: dict[str, Pose] = {}
        edge = 0.0
        for component in self.snapshot.components:
            reached = [
                se3.transform_points(pose.world_from_anchor, self.submaps[name].extent)[:, 0]
                for name, pose in self.snapshot.poses.items()
                if pose.component == component.id and name in self.submaps
            ]
            low, high = 0.0, 0.0
            if reached:
                low = float(min(x.min() for x in reached))
                high = float(max(x.max() for x in reached))
            shift = 0.0 if not offsets else edge - low + _GAP_M
            offsets[component.id] = se3.from_rotation_translation(np.eye(3), [shift, 0.0, 0.0])
            edge = shift + high
        return offsets


_GAP_M = 1.0
"""Between the maps of two components, metres."""
_STRAY_SHARE = 0.05
"""Of a sub-map's Gaussians at either end of an axis that its extent leaves out."""


def extent_of(cloud: GaussianCloud, path: Pose) -> NDArray[np.float64]:
    """(k, 3) points that a sub-map reaches in its anchor's frame: its cameras, and the corners of
    the box around all but the outermost Gaussians."""
    cameras = path[:, :3, 3]
    if len(cloud) == 0:
        return cameras
    ends = np.quantile(cloud.means, (_STRAY_SHARE, 1.0 - _STRAY_SHARE), axis=0)
    corners = np.array(list(itertools.product(*ends.T.astype(np.float64))))
    return np.concatenate([cameras, corners])


def _sibling(name: str, index: int) -> str:
    session, agent, _ = names.parse_submap(name)
    return names.submap_name(session, agent, index)
