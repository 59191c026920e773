"""What a run folder's JSON files hold, as typed records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import CorruptData
from magic_core.geometry import Camera


@dataclass(frozen=True, slots=True)
class WireBytes:
    """Size of one sub-map on the wire."""

    compact: int
    """Bytes as sent with the compact codec."""
    lossless: int
    """Bytes the same sub-map takes losslessly, float32 and PNG."""


@dataclass(frozen=True, slots=True)
class AgentReport:
    """What an agent writes about its own work: `agents/{agent}/report.json`."""

    agent: str
    frames: int
    """Frames processed."""
    lost_frames: int
    """Frames whose pose could not be tracked."""
    submaps: int
    """Sub-maps finished."""
    keyframes: tuple[int, ...]
    """Indices of the frames whose images were used for mapping, increasing."""
    camera: Camera
    """The camera of the frames as processed (after scaling)."""
    dataset: str
    """The path or address that `open_dataset` was given."""
    scale: float = 1.0
    """The image scale that `open_dataset` was given."""
    tracking_ms: tuple[float, ...] = ()
    """Tracking time of each frame, milliseconds."""
    mapping_ms: tuple[float, ...] = ()
    """Mapping time of each frame (0 where the frame was not mapped), milliseconds."""
    wire_bytes: tuple[WireBytes, ...] = ()
    """Per sub-map, in order."""
    peak_rss_bytes: int = 0
    """Largest resident memory of the agent's process."""
    wall_s: float = 0.0
    """Time from the first frame to the last acknowledgement."""
    submap_first_frames: tuple[int, ...] = ()
    """Index of each sub-map's first frame; says which sub-map a frame belongs to."""
    dropped_frames: int = 0
    """Frames of a live source that were never looked at, for lack of time."""
    skipped_keyframes: int = 0
    """Frames of a live source that were tracked but not mapped, for lack of time."""
    mapping_steps: int = 0
    """Optimisation steps taken."""
    cut_mapping_steps: int = 0
    """Optimisation steps of the schedule left out for lack of time."""
    late_ms: tuple[float, ...] = ()
    """Per frame of a live source, how long after it was due its tracking began."""


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """One loop candidate and its fate: a line of `loops.json`."""

    source: str
    """Resource name of one sub-map."""
    target: str
    """Resource name of the other."""
    similarity: float
    """Cosine similarity of the two descriptors that are most alike."""
    verdict: str
    """`accepted` or `rejected`."""
    reason: str = ""
    """Why, as a reason code or a short sentence."""
    fitness: float = 0.0
    """Share of the source's points with a partner after registration."""
    rmse_m: float = 0.0
    """RMSE of those partners' distances."""
    inliers: int = 0
    """Inlier correspondences of the coarse registration."""
    overlap: float = 0.0
    """Share of the two views that see the same surface."""
    source_keyframe: int = 0
    """Which keyframe of the source looks like the target; 0 is the anchor."""
    target_keyframe: int = 0
    """Which keyframe of the target looks like the source; 0 is the anchor."""

    @property
    def accepted(self) -> bool:
        """Whether the loop became an edge of the pose graph."""
        return self.verdict == "accepted"


@dataclass(frozen=True, slots=True)
class PlacedAnchor:
    """Where the pose graph put a sub-map."""

    component: str
    world_from_anchor: NDArray[np.float64]  # (4, 4)


@dataclass(frozen=True, slots=True)
class Components:
    """`components.json`: which sub-maps share a world frame, and where they lie in it."""

    revision: int = 0
    """Revision of the pose graph."""
    members: Mapping[str, Mapping[str, tuple[int, ...]]] = field(default_factory=dict)
    """component -> agent -> indices of its sub-maps."""
    anchors: Mapping[str, PlacedAnchor] = field(default_factory=dict)
    """Resource name of a sub-map -> its place."""

    def largest(self) -> str | None:
        """The component with most sub-maps; the lexically first of equals."""
        sizes = {name: sum(map(len, agents.values())) for name, agents in self.members.items()}
        return min(sizes, key=lambda name: (-sizes[name], name)) if sizes else None

    def component_of(self, agent: str, submap_index: int) -> str | None:
        """The component that holds one sub-map."""
        return next(
            (
                name
                for name, agents in self.members.items()
                if submap_index in agents.get(agent, ())
            ),
            None,
        )

    def main_component_of(self, agent: str) -> str | None:
        """The component that holds most of an agent's sub-maps."""
        counts = Counter(
            {name: len(agents.get(agent, ())) for name, agents in self.members.items()}
        )
        name, count = counts.most_common(1)[0] if counts else ("", 0)
        return name if count else None


def agent_of(submap_name: str) -> str:
    """The agent in `sessions/{s}/agents/{a}/submaps/{m}`."""
    return _part_after(submap_name, "agents")


def index_of(submap_name: str) -> int:
    """The sub-map index in `sessions/{s}/agents/{a}/submaps/{m}`."""
    return int(_part_after(submap_name, "submaps"))


def to_json(record: AgentReport | LoopRecord | Components) -> dict[str, Any]:
    """The JSON form of a record."""
    if isinstance(record, Components):
        anchors = {
            name: {
                "component": anchor.component,
                "world_from_anchor": np.asarray(anchor.world_from_anchor).tolist(),
            }
            for name, anchor in record.anchors.items()
        }
        members = {
            name: {agent: list(indices) for agent, indices in agents.items()}
            for name, agents in record.members.items()
        }
        return {"revision": record.revision, "components": members, "anchors": anchors}
    return asdict(record)


def agent_report_from_json(values: Mapping[str, Any]) -> AgentReport:
    """Inverse of `to_json`; unknown keys are ignored, missing ones raise CorruptData."""
    values = dict(values)
    values["camera"] = _known(Camera, values.get("camera", {}))
    values["wire_bytes"] = tuple(_known(WireBytes, item) for item in values.get("wire_bytes", ()))
    for name in ("keyframes", "tracking_ms", "mapping_ms", "submap_first_frames", "late_ms"):
        values[name] = tuple(values.get(name, ()))
    return _known(AgentReport, values)


def loop_from_json(values: Mapping[str, Any]) -> LoopRecord:
    """Inverse of `to_json`; unknown keys are ignored, missing ones raise CorruptData."""
    return _known(LoopRecord, values)


def components_from_json(values: Mapping[str, Any]) -> Components:
    """Inverse of `to_json`; a missing or wrong value raises CorruptData."""
    try:
        members = {
            str(name): {agent: tuple(map(int, indices)) for agent, indices in agents.items()}
            for name, agents in values["components"].items()
        }
        anchors = {
            name: PlacedAnchor(
                str(item["component"]),
                np.array(item["world_from_anchor"], dtype=np.float64).reshape(4, 4),
            )
            for name, item in values["anchors"].items()
        }
        return Components(int(values["revision"]), members, anchors)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CorruptData(f"components.json: {error!r} is missing or malformed") from error


_T = TypeVar("_T")


def _known(cls: type[_T], values: Mapping[str, Any]) -> _T:
    names = {item.name for item in fields(cls)}  # type: ignore[arg-type]
    try:
        return cls(**{key: value for key, value in values.items() if key in names})
    except TypeError as error:
        raise CorruptData(f"{cls.__name__}: {error}") from error


def _part_after(name: str, collection: str) -> str:
    parts = name.split("/")
    if collection not in parts[:-1]:
        raise CorruptData(f"{name!r}: expected sessions/SESSION/agents/AGENT/submaps/INDEX")
    return parts[parts.index(collection) + 1]
