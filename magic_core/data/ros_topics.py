"""Which topics of a recording are the colour, the depth and their calibrations.

Known by name: realsense-ros (`/camera/color/image_raw`, `/camera/aligned_depth_to_color/...`), the
Azure Kinect driver (`/rgb/image_raw`, `/depth_to_rgb/image_raw`), OpenNI (`/camera/rgb/...`,
`/camera/depth_registered/...`) and librealsense's recordings (`/device_0/sensor_1/Color_0/...`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from magic_core.errors import DataError

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_REGISTERED = ("aligned_depth_to_color", "depth_to_rgb", "depth_to_color", "depth_registered")
_NO_IMAGES = ("infra", "/ir/", "ir_to", "confidence", "disparity", "theora", "fisheye")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    count: int

    @property
    def image(self) -> bool:
        """Whether its messages are images."""
        return self.type in IMAGE_TYPES

    @property
    def compressed(self) -> bool:
        """Whether its images are compressed."""
        return self.type == IMAGE_TYPES[1]


@dataclass(frozen=True, slots=True)
class ChosenTopics:
    """The topics that make an RGB-D sequence."""

    colour: str
    depth: str
    registered: bool
    """Whether depth is already in the colour camera."""
    colour_info: str | None
    depth_info: str | None


def choose_topics(
    topics: list[Topic], *, colour: str | None = None, depth: str | None = None, where: Path
) -> ChosenTopics:
    """The named topics, or the best by name; DataError lists the image topics there are."""
    images = [topic for topic in topics if topic.image and topic.count]
    by_name = {topic.name: topic for topic in images}
    for asked in (colour, depth):
        if asked is not None and asked not in by_name:
            raise _no_topics(where, f"no images on {asked}", images)
    chosen_depth = depth or _best_depth(images)
    chosen_colour = colour or _best_colour(images)
    if chosen_depth is None or chosen_colour is None:
        missing = "depth" if chosen_depth is None else "colour"
        raise _no_topics(where, f"no topic looks like {missing} images", images)
    infos = [topic.name for topic in topics if topic.type == CAMERA_INFO_TYPE and topic.count]
    colour_info = _nearest(chosen_colour, infos)
    depth_info = _nearest(chosen_depth, infos)
    registered = any(word in chosen_depth.lower() for word in _REGISTERED)
    return ChosenTopics(chosen_colour, chosen_depth, registered, colour_info, depth_info)


def _best_depth(images: list[Topic]) -> str | None:
    found = [topic for topic in images if _is_depth(topic.name) and not _excluded(topic.name)]
    # Depth compressed as JPEG is no depth any more.
    found = [t for t in found if not t.compressed or t.name.endswith("compressedDepth")]
    order = sorted(
        found,
        key=lambda t: (not _is_registered(t.name), t.compressed, -t.count, t.name),
    )
    return order[0].name if order else None


def _best_colour(images: list[Topic]) -> str | None:
    found = [
        topic
        for topic in images
        if not _is_depth(topic.name)
        and not _excluded(topic.name)
        and any(word in topic.name.lower() for word in ("color", "colour", "rgb"))
    ]
    order = sorted(found, key=lambda t: ("rect" not in t.name, t.compressed, -t.count, t.name))
    return order[0].name if order else None


def _is_depth(name: str) -> bool:
    # The Azure driver's rgb_to_depth is colour seen by the depth camera.
    return "depth" in name.lower() and "rgb_to_depth" not in name.lower()


def _is_registered(name: str) -> bool:
    return any(word in name.lower() for word in _REGISTERED)


def _excluded(name: str) -> bool:
    return "rgb_to_depth" in name.lower() or any(word in name.lower() for word in _NO_IMAGES)


def _nearest(topic: str, infos: list[str]) -> str | None:
    """The calibration topic that shares most of its path with an image topic."""
    parts = topic.strip("/").split("/")
    length = len(parts)

    def shared(info: str) -> int:
        count = 0
        for mine, its in zip(parts, info.strip("/").split("/"), strict=False):
            if mine != its:
                break
            count += 1
        return count

    best = max(infos, key=lambda info: (shared(info), -len(info)), default=None)
    while len(parts) > 1 and _is_image_word(parts[-1]):
        parts.pop()  # what remains of `/camera/color/image_raw` must agree
    wanted = len(parts) if len(parts) < length else length - 1
    return best if best is not None and shared(best) >= wanted else None


def _is_image_word(part: str) -> bool:
    return part.startswith(("image", "compressed")) or part in ("data", "raw")


def _no_topics(where: Path, problem: str, images: list[Topic]) -> DataError:
    listed = ", ".join(f"{topic.name} ({topic.count})" for topic in images) or "none"
    return DataError(
        f"{where}: {problem}. Image topics in it: {listed}. Choose with "
        f"'rosbag:{where}?colour=/TOPIC&depth=/TOPIC'"
    )
