"""From a path to the frame sources in it: one per agent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl, unquote

from magic_core.data.frame import FrameSource
from magic_core.data.plain import is_plain, open_plain
from magic_core.data.record3d import is_record3d, open_record3d
from magic_core.data.replica import is_replica, open_replica
from magic_core.data.rosbag import is_rosbag, open_rosbag
from magic_core.data.scannet import is_scannet, open_scannet
from magic_core.data.scannetpp import is_scannetpp, open_scannetpp
from magic_core.data.sequence import FileSequence
from magic_core.data.tum import is_tum, open_tum
from magic_core.errors import DataError

SYNTHETIC_SCHEME = "synthetic:"
REALSENSE_SCHEME = "realsense:"
ROSBAG_SCHEME = "rosbag:"


@dataclass(frozen=True, slots=True)
class Layout:
    """One way of storing a recording; a new one is a file with these two functions, and a line."""

    name: str
    detect: Callable[[Path], bool]
    """Whether a path holds one recording in this layout; looks at names only."""
    open: Callable[..., FileSequence]
    """(path, name=, scale=, max_frames=, stride=) -> the recording."""
    expected: str
    """What it looks like, for the message of who found none."""


LAYOUTS: tuple[Layout, ...] = (
    Layout("TUM RGB-D", is_tum, open_tum, "rgb.txt + depth.txt"),
    Layout("Replica", is_replica, open_replica,
           "results/frame%06d.jpg + results/depth%06d.png + cam_params.json (Aria exports too)"),
    Layout("ScanNet++ iPhone", is_scannetpp, open_scannetpp,
           "iphone/pose_intrinsic_imu.json + iphone/rgb/ + iphone/depth/"),
    Layout("Record3D", is_record3d, open_record3d, "an .r3d file, or metadata + rgbd/"),
    Layout("ScanNet", is_scannet, open_scannet, "color/ + depth/ + pose/ + intrinsic/"),
    Layout("ROS bag", is_rosbag, open_rosbag,
           "a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag"),
    Layout("plain folder", is_plain, open_plain, "rgb/ + depth/ + cam_params.json"),
)  # fmt: skip
"""Every stored layout; the first that detects a path opens it."""


def open_dataset(
    path: Path | str, *, scale: float = 1.0, max_frames: int | None = None, stride: int = 1
) -> list[FrameSource]:
    """One source per agent of a dataset, sorted by name.

    A path that is a recording itself gives one source, named after it where its name is
    `agent_*` and `agent_0` otherwise. A folder of recordings gives one source per recording;
    where some are called `agent_*`, only those count. Addresses instead of paths:
    `synthetic://flat?agents=3&frames=120` renders the built-in flat, `realsense:` is a live
    camera, `rosbag:PATH?colour=/TOPIC&depth=/TOPIC` chooses the topics of a bag. `stride` and
    `max_frames` choose frames, `scale` their size.
    """
    address = str(path)
    if address.startswith(SYNTHETIC_SCHEME):
        from magic_core.data.synthetic import open_synthetic  # loads Open3D only when asked for

        return open_synthetic(address, scale=scale, max_frames=max_frames, stride=stride)
    if address.startswith(REALSENSE_SCHEME):
        from magic_core.data.realsense import RealSenseSource

        return [RealSenseSource(address, scale=scale, max_frames=max_frames, stride=stride)]
    if address.startswith(ROSBAG_SCHEME):
        return [_bag_by_topics(address, scale=scale, max_frames=max_frames, stride=stride)]
    sources: list[FrameSource] = []
    for name, recording in recordings(Path(path).expanduser()):
        layout = layout_of(recording)
        assert layout is not None
        sources.append(
            layout.open(recording, name=name, scale=scale, max_frames=max_frames, stride=stride)
        )
    return sources


def recordings(path: Path) -> list[tuple[str, Path]]:
    """(agent name, path) of every recording at or directly under `path`."""
    if not path.exists():
        raise DataError(f"{path}: no such folder or file; give the path of a dataset")
    if layout_of(path) is not None:
        name = _agent_name(path.resolve())
        return [(name if name.startswith("agent_") else "agent_0", path)]
    children = sorted(path.iterdir()) if path.is_dir() else []
    found = [child for child in children if layout_of(child) is not None]
    agents = [child for child in found if child.name.startswith("agent_")]
    if not found:
        raise DataError(f"{path}: no recording found{_nearly(path)}. Looked for {_expectations()}")
    names = [_agent_name(child) for child in (agents or found)]
    doubled = {name for name in names if names.count(name) > 1}
    if doubled:
        raise DataError(
            f"{path}: two recordings are called {', '.join(sorted(doubled))}; rename one of them, "
            "or move it elsewhere"
        )
    return list(zip(names, agents or found, strict=True))


def layout_of(path: Path) -> Layout | None:
    """The layout of the recording at `path`, None where there is none."""
    return next((layout for layout in LAYOUTS if layout.detect(path)), None)


def _agent_name(path: Path) -> str:
    return path.name if path.is_dir() else path.stem


def _expectations() -> str:
    kinds = "; ".join(f"{layout.name}: {layout.expected}" for layout in LAYOUTS)
    return f"one recording, or a folder of them (agent_0, agent_1, ...), in one of these: {kinds}"


def _nearly(path: Path) -> str:
    """What is there instead, so that a wrong path shows."""
    if not path.is_dir():
        return f" ({path.suffix or 'no suffix'} is no recording)"
    names = [child.name + ("/" if child.is_dir() else "") for child in sorted(path.iterdir())]
    if not names:
        return " (the folder is empty)"
    return f" (it holds {', '.join(names[:8])}{', ...' if len(names) > 8 else ''})"


def _bag_by_topics(
    address: str, *, scale: float, max_frames: int | None, stride: int
) -> FileSequence:
    path, _, query = address.removeprefix(ROSBAG_SCHEME).partition("?")
    given = dict(parse_qsl(query))
    unknown = set(given) - {"colour", "depth"}
    bag = Path(unquote(path)).expanduser()
    if unknown or not is_rosbag(bag):
        raise DataError(
            f"{address}: expected rosbag:PATH?colour=/TOPIC&depth=/TOPIC with the path of a bag"
        )
    name = _agent_name(bag.resolve())
    return open_rosbag(
        bag,
        name=name if name.startswith("agent_") else "agent_0",
        scale=scale,
        max_frames=max_frames,
        stride=stride,
        colour_topic=given.get("colour"),
        depth_topic=given.get("depth"),
    )
