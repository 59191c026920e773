"""The jobs: functions that run in a worker process. They read blobs wherever the store has them."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from magicslam.v1 import submap_pb2

from magic_core.errors import MagicError
from magic_core.geometry import Camera
from magic_core.geometry.seams import NO_SEAMS, Seams
from magic_core.wire import geometry, images
from magic_server.jobs.attempt import Attempt, made_whole
from magic_server.jobs.delivery import (
    Delivery,
    FolderDelivery,
    JobFile,
    SpacedReports,
    spaced_keeping,
)
from magic_server.seams import shares_of
from magic_server.store.rows import StoredSubmap

if TYPE_CHECKING:
    from magic_core.gaussians import GaussianCloud
    from magic_core.gaussians.stream import Pieces
    from magic_core.wire.records import MapFormat
    from magic_server.globalmap import MergeConfig
    from magic_server.posegraph import PoseGraphConfig
    from magic_server.posegraph.arrays import ArraySolution, GraphArrays
    from magic_server.registration import AnchorView, PreparedView, RegistrationConfig
    from magic_server.registration.register import RegistrationResult


@dataclass(frozen=True, slots=True)
class PlacedFiles:
    """A stored sub-map and where the pose graph puts it."""

    name: str
    stored: StoredSubmap
    world_from_anchor: np.ndarray  # (4, 4)
    seams: Seams = NO_SEAMS
    """What its neighbours ask of its frames."""


@dataclass(frozen=True, slots=True)
class QueryImage:
    """An encoded RGB-D image that is to be placed in the map; it was checked."""

    camera: Camera
    colour: bytes
    colour_media_type: str
    depth_png: bytes
    metres_per_unit: float


@dataclass(frozen=True, slots=True)
class StoredSource:
    """A stored sub-map as a merge reads it: each part when it is asked for, and kept by nobody."""

    stored: StoredSubmap
    header: submap_pb2.SubmapHeader
    world_from_anchor: np.ndarray  # (4, 4)
    seams: Seams = NO_SEAMS

    @classmethod
    def of(cls, placed: PlacedFiles) -> StoredSource:
        """Read the header alone."""
        header = submap_pb2.SubmapHeader.FromString(placed.stored.header)
        return cls(placed.stored, header, placed.world_from_anchor, placed.seams)

    @property
    def camera(self) -> Camera:
        """The camera of all its keyframes."""
        return geometry.camera_from_proto(self.header.camera)

    def gaussians(self) -> GaussianCloud:
        """The Gaussians, in the anchor frame."""
        from magic_core.gaussians import codec

        return codec.decode(self.stored.blobs[self.header.gaussians_blob].read())

    def gaussian_count(self) -> int:
        """How many there are, without decoding them."""
        from magic_core.gaussians import codec

        blob = self.stored.blobs[self.header.gaussians_blob]
        return codec.gaussian_count(blob.head(codec.HEADER_BYTES))

    def keyframe_poses(self) -> list[np.ndarray]:
        """anchor_from_camera (4, 4) of every keyframe, with what its seams ask of it."""
        keyframes = self.header.keyframes
        share = shares_of(self.header.trajectory)
        tracked = [geometry.pose_from_proto(item.anchor_from_camera) for item in keyframes]
        return list(self.seams.spread(tracked, [share[item.frame_index] for item in keyframes]))

    def images(self, keyframe: int) -> tuple[np.ndarray, np.ndarray]:
        """Colour (h, w, 3) and depth (h, w) in metres of one keyframe."""
        return _images(self.header, self.stored, keyframe)


@dataclass(frozen=True, slots=True)
class MergeTask:
    """What a merge needs."""

    submaps: tuple[PlacedFiles, ...]
    config: MergeConfig
    threads: int
    """Threads of the rasteriser; 0 for one per core."""
    delivery: Delivery
    """For the results, the progress and, in a folder, what an interrupted merge left."""


@dataclass(frozen=True, slots=True)
class MergeOutcome:
    """What a merge made."""

    gaussian_count: int
    ply: JobFile
    lossless: JobFile
    compact: JobFile


@dataclass(frozen=True, slots=True)
class PreviewTask:
    """What a preview needs."""

    submaps: tuple[PlacedFiles, ...]
    kinds: tuple[MapFormat, ...]
    delivery: Delivery
    """A folder does not exist yet, or an earlier try at the same job made it."""


@dataclass(frozen=True, slots=True)
class PreviewOutcome:
    """A preview's files: the file, its SHA-256 in hex and its length by format."""

    gaussian_count: int
    files: tuple[tuple[MapFormat, tuple[JobFile, str, int]], ...]


def append_submaps(task: PreviewTask) -> PreviewOutcome:
    """Write placed sub-maps one behind the other, with one of them in memory at a time."""
    import hashlib

    from magic_core.gaussians import stream
    from magic_server.globalmap.placement import placed_gaussians

    sources = [StoredSource.of(item) for item in task.submaps]

    def pieces() -> Iterator[GaussianCloud]:
        return (placed_gaussians(source) for source in sources)

    write = {
        "ply": stream.write_ply_pieces,
        "lossless": stream.write_lossless_pieces,
        "compact": stream.write_compact_pieces,
    }
    files = []
    with task.delivery.working() as work:
        # A folder of the server's is there as a whole or not at all.
        folder = work if isinstance(task.delivery, FolderDelivery) else work / "preview"
        with made_whole(folder) as partial:
            for kind in task.kinds:
                path = partial / kind
                write[kind](path, pieces)
                with path.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                files.append((kind, folder / kind, digest, path.stat().st_size))
        delivered = [(kind, (task.delivery.deliver(p), d, n)) for kind, p, d, n in files]
    count = sum(source.gaussian_count() for source in sources)
    return PreviewOutcome(count, tuple(delivered))


def verify_loop(
    source: StoredSubmap,
    target: StoredSubmap,
    config: RegistrationConfig,
    keyframes: tuple[int, int],
) -> RegistrationResult:
    """Register the views of two sub-maps; `keyframes` are those of each that look alike."""
    from magic_server.registration.register import register

    seen, known = keyframes
    return register(_prepared(source, seen, config), _prepared(target, known, config), config)


def localize_image(
    image: QueryImage,
    targets: tuple[StoredSubmap, ...],
    config: RegistrationConfig,
    keyframes: tuple[int, ...],
) -> list[RegistrationResult | None]:
    """Register an image to sub-maps, up to and with the first that accepts it.

    `keyframes` holds which keyframe of each looks like the image.
    The result of each is target_from_camera, None where a sub-map could not be read.
    """
    from magic_server.registration import prepare
    from magic_server.registration.register import register

    view = prepare(_query_view(image), config)
    results: list[RegistrationResult | None] = []
    for target, keyframe in zip(targets, keyframes, strict=True):
        try:
            prepared = _prepared(target, keyframe, config)
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
    """Merge placed sub-maps and write the map in every format.

    One block of the map is in memory at a time. What an interrupted merge of the same sub-maps left
    is taken up where it was.
    """
    with task.delivery.working() as folder:
        return _merged(task, folder)


def _merged(task: MergeTask, folder: Path) -> MergeOutcome:
    threads = task.threads or os.cpu_count() or 1
    os.environ["MAGIC_THREADS"] = str(threads)
    from magic_server.globalmap.merge import merge_into
    from magic_server.globalmap.parts import files_of

    attempt, tell = Attempt(folder), SpacedReports(task.delivery)

    def report(share: float, stage: str) -> None:
        attempt.report(share, stage)
        tell(share, stage)

    config = task.config
    if not config.threads:
        config = dataclasses.replace(config, threads=threads)
    sources = [StoredSource.of(item) for item in task.submaps]
    saved = spaced_keeping(task.delivery, lambda: files_of(folder))
    parts, summary = merge_into(folder, sources, config, progress=report, saved=saved)
    pieces = functools.partial(parts.clouds, summary.blocks)
    return write_map(
        pieces, summary.gaussians, folder=folder, attempt=attempt, delivery=task.delivery
    )


def write_map(
    pieces: Pieces, count: int, *, folder: Path, attempt: Attempt, delivery: Delivery
) -> MergeOutcome:
    """Write a map of `count` Gaussians in every format and hand the files over."""
    from magic_core.gaussians import stream

    made = []
    for name, write in (
        ("map.ply", stream.write_ply_pieces),
        ("map.lossless", stream.write_lossless_pieces),
        ("map.compact", stream.write_compact_pieces),
    ):
        path = folder / name
        with attempt.file(path) as partial:
            write(partial, pieces)
        made.append(delivery.deliver(path))
    return MergeOutcome(count, *made)


@functools.lru_cache(maxsize=16)
def _prepared(stored: StoredSubmap, keyframe: int, config: RegistrationConfig) -> PreparedView:
    """A sub-map's view; kept, because a new sub-map is compared with several others in a row."""
    from magic_server.registration import prepare

    if keyframe and not config.max_keyframes:
        config = dataclasses.replace(config, max_keyframes=1)
    return prepare(_view(stored, keyframe, config), config)


def _query_view(image: QueryImage) -> AnchorView:
    from magic_server.registration import AnchorView

    size = (image.camera.width, image.camera.height)
    colour = images.decode_colour(image.colour, image.colour_media_type, size=size)
    unit = image.metres_per_unit
    depth = images.decode_depth(image.depth_png, images.PNG, metres_per_unit=unit, size=size)
    return AnchorView(camera=image.camera, colour=colour, depth=depth)


def _view(stored: StoredSubmap, keyframe: int, config: RegistrationConfig) -> AnchorView:
    """What registration wants of a sub-map: the images of the anchor, of the keyframe that looks
    like the other side (unless it is the anchor), and of some others."""
    from magic_server.registration import AnchorView

    header = submap_pb2.SubmapHeader.FromString(stored.header)
    camera = geometry.camera_from_proto(header.camera)
    others = range(1, len(header.keyframes))
    if len(others) > config.max_keyframes:
        spread = np.linspace(1, len(header.keyframes) - 1, config.max_keyframes)
        others = sorted(set(np.rint(spread).astype(int).tolist()))
    if keyframe:  # in front: the coarse methods on points see the first images only
        others = [keyframe, *(other for other in others if other != keyframe)]
        others = others[: config.max_keyframes]  # one more would be decoded for nothing
    colour, depth = _images(header, stored, 0)
    keyframes = []
    for index in others:
        pose = geometry.pose_from_proto(header.keyframes[index].anchor_from_camera)
        keyframes.append((pose, *_images(header, stored, index)))
    means = None
    if "means" in config.methods:
        from magic_core.gaussians import codec

        means = codec.decode(stored.blobs[header.gaussians_blob].read()).means
    return AnchorView(camera, colour, depth, tuple(keyframes), means, lead=int(keyframe > 0))


def _images(
    header: submap_pb2.SubmapHeader, stored: StoredSubmap, keyframe: int
) -> tuple[np.ndarray, np.ndarray]:
    message = header.keyframes[keyframe]
    size = (header.camera.width, header.camera.height)
    colour = images.decode_colour(
        stored.blobs[message.colour_blob].read(),
        header.blobs[message.colour_blob].media_type,
        size=size,
    )
    depth = images.decode_depth(
        stored.blobs[message.depth_blob].read(),
        header.blobs[message.depth_blob].media_type,
        metres_per_unit=header.blobs[message.depth_blob].metres_per_unit,
        size=size,
    )
    return colour, depth
