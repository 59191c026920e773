"""The jobs: functions that run in a worker process. They read blobs from disk by path."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from magicslam.v1 import submap_pb2

from magic_core.errors import MagicError
from magic_core.geometry import Camera
from magic_core.wire import decode_submap, geometry, images
from magic_server.store.blobs import read_checked
from magic_server.store.rows import StoredSubmap

if TYPE_CHECKING:
    from magic_server.globalmap import MergeConfig
    from magic_server.posegraph import PoseGraphConfig
    from magic_server.posegraph.arrays import ArraySolution, GraphArrays
    from magic_server.registration import AnchorView, PreparedView, RegistrationConfig
    from magic_server.registration.register import RegistrationResult

_PROGRESS_INTERVAL_S = 0.2


@dataclass(frozen=True, slots=True)
class PlacedFiles:
    """A stored sub-map and where the pose graph puts it."""

    name: str
    stored: StoredSubmap
    world_from_anchor: np.ndarray  # (4, 4)


@dataclass(frozen=True, slots=True)
class QueryImage:
    """An encoded RGB-D image that is to be placed in the map; it was checked."""

    camera: Camera
    colour: bytes
    colour_media_type: str
    depth_png: bytes
    metres_per_unit: float


@dataclass(frozen=True, slots=True)
class MergeTask:
    """What a merge needs."""

    submaps: tuple[PlacedFiles, ...]
    config: MergeConfig
    threads: int
    """Threads of the rasteriser; 0 for one per core."""
    folder: Path
    """An empty folder for the results and the progress file."""


@dataclass(frozen=True, slots=True)
class MergeOutcome:
    """What a merge made: files in its folder."""

    gaussian_count: int
    ply: Path
    lossless: Path
    compact: Path


def verify_loop(
    source: StoredSubmap, target: StoredSubmap, config: RegistrationConfig
) -> RegistrationResult:
    """Register the views of two sub-maps."""
    from magic_server.registration.register import register

    return register(_prepared(source, config), _prepared(target, config), config)


def localize_image(
    image: QueryImage, targets: tuple[StoredSubmap, ...], config: RegistrationConfig
) -> list[RegistrationResult | None]:
    """Register an image to sub-maps, up to and with the first that accepts it.

    The result of each is target_from_camera, None where a sub-map could not be read.
    """
    from magic_server.registration import prepare
    from magic_server.registration.register import register

    view = prepare(_query_view(image), config)
    results: list[RegistrationResult | None] = []
    for target in targets:
        try:
            prepared = _prepared(target, config)
        except (OSError, MagicError):  # deleted meanwhile, or damaged on disk
            results.append(None)
            continue
        results.append(register(view, prepared, config))
        if results[-1] is not None and results[-1].accepted:
            break
    return results


def solve_pose_graph(graph: GraphArrays, config: PoseGraphConfig) -> ArraySolution:
    """Solve a session's pose graph."""
    from magic_server.posegraph.solve import solve_arrays

    return solve_arrays(graph, config)


def merge_submaps(task: MergeTask) -> MergeOutcome:
    """Merge placed sub-maps and write the map in every format."""
    threads = task.threads or os.cpu_count() or 1
    os.environ["MAGIC_THREADS"] = str(threads)
    from magic_core.gaussians import codec
    from magic_core.gaussians.ply import write_ply
    from magic_server.globalmap import PlacedSubmap, build_global_map

    report = _progress_writer(task.folder / "progress.json")
    report(0.0, "reading sub-maps")
    placed = [
        PlacedSubmap(_read_submap(item.stored), item.world_from_anchor) for item in task.submaps
    ]
    config = task.config
    if not config.threads:
        config = dataclasses.replace(config, threads=threads)
    cloud = build_global_map(placed, config, progress=report).cloud
    outcome = MergeOutcome(
        len(cloud), *(task.folder / name for name in ("map.ply", "map.lossless", "map.compact"))
    )
    write_ply(outcome.ply, cloud)
    outcome.lossless.write_bytes(codec.encode_lossless(cloud))
    outcome.compact.write_bytes(codec.encode_compact(cloud))
    return outcome


def read_progress(folder: Path) -> tuple[float, str] | None:
    """(share done, stage) that a merge last reported into its folder, or None."""
    try:
        share, stage = json.loads((folder / "progress.json").read_text())
    except (FileNotFoundError, ValueError):
        return None
    return float(share), str(stage)


@functools.lru_cache(maxsize=16)
def _prepared(stored: StoredSubmap, config: RegistrationConfig) -> PreparedView:
    """A sub-map's view; kept, because a new sub-map is compared with several others in a row."""
    from magic_server.registration import prepare

    return prepare(_view(stored, config.max_keyframes), config)


def _query_view(image: QueryImage) -> AnchorView:
    from magic_server.registration import AnchorView

    size = (image.camera.width, image.camera.height)
    colour = images.decode_colour(image.colour, image.colour_media_type, size=size)
    unit = image.metres_per_unit
    depth = images.decode_depth(image.depth_png, metres_per_unit=unit, size=size)
    return AnchorView(camera=image.camera, colour=colour, depth=depth)


def _view(stored: StoredSubmap, max_keyframes: int) -> AnchorView:
    """The images of a sub-map that registration wants: the anchor's and some keyframes'."""
    from magic_server.registration import AnchorView

    header = submap_pb2.SubmapHeader.FromString(stored.header)
    camera = geometry.camera_from_proto(header.camera)
    others = range(1, len(header.keyframes))
    if len(others) > max_keyframes:
        spread = np.linspace(1, len(header.keyframes) - 1, max_keyframes)
        others = sorted(set(np.rint(spread).astype(int).tolist()))
    colour, depth = _images(header, stored, 0)
    keyframes = []
    for index in others:
        pose = geometry.pose_from_proto(header.keyframes[index].anchor_from_camera)
        keyframes.append((pose, *_images(header, stored, index)))
    return AnchorView(camera=camera, colour=colour, depth=depth, keyframes=tuple(keyframes))


def _images(
    header: submap_pb2.SubmapHeader, stored: StoredSubmap, keyframe: int
) -> tuple[np.ndarray, np.ndarray]:
    message = header.keyframes[keyframe]
    size = (header.camera.width, header.camera.height)
    colour = images.decode_colour(
        read_checked(stored.blobs[message.colour_blob]),
        header.blobs[message.colour_blob].media_type,
        size=size,
    )
    depth = images.decode_depth(
        read_checked(stored.blobs[message.depth_blob]),
        metres_per_unit=header.blobs[message.depth_blob].metres_per_unit,
        size=size,
    )
    return colour, depth


def _read_submap(stored: StoredSubmap):
    header = submap_pb2.SubmapHeader.FromString(stored.header)
    return decode_submap(header, [read_checked(path) for path in stored.blobs])


def _progress_writer(path: Path) -> Callable[[float, str], None]:
    """Replaces the progress file in one step, a few times a second at most."""
    last = -1.0

    def report(share: float, stage: str) -> None:
        nonlocal last
        if time.monotonic() - last < _PROGRESS_INTERVAL_S and 0.0 < share < 1.0:
            return
        last = time.monotonic()
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps([share, stage]))
        partial.replace(path)

    return report
