"""RGB-D recordings in ROS bags: ROS 1 (.bag) and ROS 2 (.mcap, .db3, or the folder of a bag).

RealSense and Azure Kinect drivers and librealsense's own recorder write these. Depth that is not
registered to colour is moved there with the recording's extrinsics. Times are the messages' header
stamps; a bag holds no ground truth. Messages are read one at a time, at random.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.data.association import associate
from magic_core.data.images import Colour, Depth
from magic_core.data.intrinsics import CAMERA_FILE, Intrinsics, find_intrinsics, read_intrinsics
from magic_core.data.pose_files import pose_from_xyzw
from magic_core.data.ros_images import camera_of, colour_image, depth_image
from magic_core.data.ros_topics import ChosenTopics, Topic, choose_topics
from magic_core.data.sequence import FileSequence, require_increasing_times, subsample
from magic_core.data.two_cameras import DepthCamera
from magic_core.errors import DataError
from magic_core.geometry import Camera, se3

SUFFIXES = (".bag", ".mcap", ".db3")
ROS2_METADATA = "metadata.yaml"
MAX_TIME_DIFFERENCE_S = 0.020
MILLIMETRES = 1000.0


def is_rosbag(path: Path) -> bool:
    """Whether `path` is a bag file, or the folder of a ROS 2 bag."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    stored = any(child.suffix in SUFFIXES for child in path.glob("*")) if path.is_dir() else False
    return stored and (path / ROS2_METADATA).is_file()


def open_rosbag(
    path: Path,
    *,
    name: str = "agent_0",
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
    colour_topic: str | None = None,
    depth_topic: str | None = None,
) -> FileSequence:
    """One bag; frames are delivered in the colour camera."""
    bag = Bag(path)
    chosen = choose_topics(bag.topics, colour=colour_topic, depth=depth_topic, where=path)
    intrinsics = _colour_intrinsics(bag, chosen)
    frames, left_out = _frames(bag, chosen)
    require_increasing_times(frames, where=path)
    return FileSequence(
        name,
        subsample(frames, stride=stride, max_frames=max_frames),
        intrinsics=intrinsics,
        scale=scale,
        depth_camera=_depth_camera(bag, chosen, intrinsics, frames[0]),
        left_out=left_out,
    )


class Bag:
    """An open bag: its topics, and its messages by topic and time. May be used by threads."""

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self._lock = threading.Lock()
        standard = get_typestore(Stores.ROS2_HUMBLE)  # for bags that hold no definitions
        try:
            self._reader = AnyReader([path], default_typestore=standard)
            self._reader.open()
        except (AnyReaderError, OSError, ValueError, KeyError, struct.error) as error:
            raise DataError(
                f"{path}: not readable as a ROS bag ({error}); `rosbag reindex` or `ros2 bag "
                "reindex` repairs one that was cut short"
            ) from error
        self.topics = [
            Topic(name, info.msgtype or "", info.msgcount)
            for name, info in self._reader.topics.items()
        ]

    def stamps(self, topic: str) -> list[tuple[float, int]]:
        """(header stamp in seconds, log time in ns) of a topic's messages, nothing decoded."""
        peek = _cdr_stamp if self._reader.is2 else _ros1_stamp
        return [(peek(raw), time) for _, time, raw in self._raw(topic)]

    def first(self, topic: str) -> Any:
        """The first message of a topic, None where it has none."""
        return next(self.messages(topic), None)

    def messages(self, topic: str) -> Iterator[Any]:
        """The messages of a topic in order of time."""
        for type_name, _, raw in self._raw(topic):
            yield self._decoded(type_name, raw, topic)

    def at(self, topic: str, time_ns: int) -> Any:
        """The message of a topic that was logged at a time."""
        found = self._raw(topic, start=time_ns, stop=time_ns + 1)
        for type_name, _, raw in found:
            return self._decoded(type_name, raw, topic)
        raise DataError(f"{self.path}: {topic} has no message at {time_ns} ns any more; reindex it")

    def _raw(
        self, topic: str, *, start: int | None = None, stop: int | None = None
    ) -> list[tuple[str, int, bytes]] | Iterator[tuple[str, int, bytes]]:
        connections = [c for c in self._reader.connections if c.topic == topic]
        if not connections:
            return []
        if start is None:
            return self._walk(connections)
        with self._lock:
            return list(self._walk(connections, start, stop))

    def _walk(
        self, connections: list[Any], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        try:
            for connection, time, raw in self._reader.messages(connections, start, stop):
                yield connection.msgtype, time, bytes(raw)
        except Exception as error:  # the readers raise errors of many libraries on damaged data
            raise DataError(
                f"{self.path}: damaged at {connections[0].topic} ({error!r}); reindex the bag, or "
                "record again"
            ) from error

    def _decoded(self, type_name: str, raw: bytes, topic: str) -> Any:
        try:
            return self._reader.deserialize(raw, type_name)
        except Exception as error:  # see above
            raise DataError(f"{self.path}: {topic}: a damaged message ({error!r})") from error


@dataclass(frozen=True, slots=True)
class _BagFrame:
    """One colour message and its depth message."""

    bag: Bag
    topics: ChosenTopics
    timestamp_s: float
    colour_ns: int
    depth_ns: int
    world_from_camera: NDArray[np.float64] | None = None
    cameras: tuple[Camera, Camera] | None = None

    @property
    def label(self) -> str:
        return f"{self.topics.colour} at {self.timestamp_s:.3f} s"

    def read_colour(self) -> Colour:
        message = self.bag.at(self.topics.colour, self.colour_ns)
        return colour_image(message, where=f"{self.bag.path}: {self.label}")

    def read_depth(self, depth_scale: float) -> Depth:
        message = self.bag.at(self.topics.depth, self.depth_ns)
        where = f"{self.bag.path}: {self.topics.depth}"
        return depth_image(message, units_per_metre=depth_scale, where=where)

    def damaged(self) -> list[str]:
        return []  # every message was walked over when the bag was opened


def _frames(bag: Bag, chosen: ChosenTopics) -> tuple[list[_BagFrame], int]:
    colour, depth = bag.stamps(chosen.colour), bag.stamps(chosen.depth)
    pairs = associate(
        np.array([stamp for stamp, _ in colour]),
        np.array([stamp for stamp, _ in depth]),
        max_difference_s=MAX_TIME_DIFFERENCE_S,
    )
    if not len(pairs):
        raise DataError(
            f"{bag.path}: no image of {chosen.colour} has one of {chosen.depth} within "
            f"{1000 * MAX_TIME_DIFFERENCE_S:.0f} ms; do both topics use one clock?"
        )
    frames = [_BagFrame(bag, chosen, colour[i][0], colour[i][1], depth[j][1]) for i, j in pairs]
    frames.sort(key=lambda frame: frame.timestamp_s)
    return frames, len(colour) - len(frames)


def _colour_intrinsics(bag: Bag, chosen: ChosenTopics) -> Intrinsics:
    """A cam_params.json beside the bag, else the bag's own calibration."""
    units = _units_per_metre(bag, chosen)
    path = find_intrinsics(bag.path.parent, levels=0)
    if path is not None:
        return read_intrinsics(path, default_depth_scale=units)
    info = bag.first(chosen.colour_info) if chosen.colour_info else None
    if info is None:
        raise DataError(
            f"{bag.path}: no CameraInfo beside {chosen.colour}; record its camera_info topic too, "
            f"or write a {CAMERA_FILE} beside the bag"
        )
    camera, distortion = camera_of(info, where=f"{bag.path}: {chosen.colour_info}")
    return Intrinsics(camera, units, distortion)


def _depth_camera(
    bag: Bag, chosen: ChosenTopics, colour: Intrinsics, first: _BagFrame
) -> DepthCamera | None:
    """The depth camera where depth is not registered to colour; None where it is."""
    if chosen.registered:
        return None
    info = bag.first(chosen.depth_info) if chosen.depth_info else None
    if info is None:
        height, width = first.read_depth(1.0).shape
        if (width, height) == (colour.camera.width, colour.camera.height):
            return None
        raise DataError(
            f"{bag.path}: {chosen.depth} is {width}x{height} and has no CameraInfo; record its "
            "camera_info topic too, or the driver's depth that is aligned to colour"
        )
    camera, distortion = camera_of(info, where=f"{bag.path}: {chosen.depth_info}")
    return DepthCamera(camera, distortion, _colour_from_depth(bag, chosen))


def _colour_from_depth(bag: Bag, chosen: ChosenTopics) -> NDArray[np.float64] | None:
    """The recorded extrinsics; DataError where the bag has none."""
    links = _static_transforms(bag)
    frames = [
        bag.first(topic).header.frame_id.strip("/") for topic in (chosen.colour, chosen.depth)
    ]
    if frames[0] == frames[1]:
        return None  # the driver says that both are one camera
    found = _librealsense_extrinsics(bag, chosen)
    if found is None:
        found = chained(links, frames[0], frames[1])
    if found is None:
        raise DataError(
            f"{bag.path}: depth ({frames[1]}) is not registered to colour ({frames[0]}), and "
            "/tf_static does not link them; record /tf_static too, or the depth that is aligned "
            "to colour"
        )
    return None if np.allclose(found, np.eye(4), atol=1e-6) else found


def chained(
    links: dict[tuple[str, str], NDArray[np.float64]], target: str, source: str
) -> NDArray[np.float64] | None:
    """target_from_source over any number of links (parent, child) -> parent_from_child."""
    both = dict(links) | {(child, parent): se3.inverse(t) for (parent, child), t in links.items()}
    reached: dict[str, NDArray[np.float64]] = {source: se3.identity()}
    waiting = [source]
    while waiting:
        here = waiting.pop()
        for (parent, child), parent_from_child in both.items():
            if child == here and parent not in reached:
                reached[parent] = parent_from_child @ reached[here]
                waiting.append(parent)
    return reached.get(target)


def _static_transforms(bag: Bag) -> dict[tuple[str, str], NDArray[np.float64]]:
    links = {}
    for message in bag.messages("/tf_static"):
        for link in message.transforms:
            parent, child = link.header.frame_id.strip("/"), link.child_frame_id.strip("/")
            links[parent, child] = _matrix(link.transform)
    return links


def _librealsense_extrinsics(bag: Bag, chosen: ChosenTopics) -> NDArray[np.float64] | None:
    """librealsense's .bag files: `.../Color_0/tf/0` maps the reference stream into the stream."""
    matrices = []
    for topic in (chosen.colour, chosen.depth):
        stream = topic.split("/image/")[0]
        names = [t.name for t in bag.topics if t.name.startswith(f"{stream}/tf/")]
        message = bag.first(names[0]) if names else None
        if message is None or not hasattr(message, "rotation"):
            return None
        matrices.append(_matrix(message))
    return matrices[0] @ se3.inverse(matrices[1])


def _matrix(transform: Any) -> NDArray[np.float64]:
    q, t = transform.rotation, transform.translation
    return pose_from_xyzw(np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z]))


def _units_per_metre(bag: Bag, chosen: ChosenTopics) -> float:
    """librealsense's depth unit where it was recorded, else millimetres (REP 118)."""
    sensor = chosen.depth.split("/Depth_0/")[0]
    for topic in bag.topics:
        if topic.name.replace(" ", "_") == f"{sensor}/option/Depth_Units/value":
            try:
                return 1.0 / float(bag.first(topic.name).data)
            except (TypeError, ValueError, ZeroDivisionError) as error:
                raise DataError(f"{bag.path}: {topic.name}: no depth unit ({error})") from error
    return MILLIMETRES


def _ros1_stamp(raw: bytes) -> float:
    _, seconds, nanoseconds = struct.unpack_from("<III", raw)
    return seconds + nanoseconds * 1e-9


def _cdr_stamp(raw: bytes) -> float:
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return seconds + nanoseconds * 1e-9
