"""The checks of a server that need no network, each on one damaged message."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError
from magicslam.v1 import archive_pb2, submap_pb2

from magic_core.errors import InvalidInput
from magic_core.gaussians import codec
from magic_core.wire import (
    ChunkCursor,
    EncodedSubmap,
    SubmapLimits,
    check_blob,
    check_chunk,
    check_header,
    chunks_of,
    decode_submap,
    encode_submap,
    geometry,
    images,
)
from magic_core.wire.chunks import sha256
from magic_core.wire.submap import decode_odometry
from magic_server.archive.checking import check_archive
from magic_server.archive.layout import (
    MANIFEST,
    SESSION,
    Member,
    blob_path,
    manifest_of,
    padding,
    tar_header,
)
from magic_server.archive.reader import ArchiveReader
from magic_server.store import BlobFolder
from tests.faults.mutations import (
    mutate_message,
    mutated_bytes,
    mutated_frame,
    mutated_png,
)
from tests.small_world import DIMENSION, MODEL_ID, make_submap

LIMITS = SubmapLimits(max_bytes=1 << 20, max_frames=200, max_keyframes=20, max_gaussians=10_000)


@dataclass(frozen=True, slots=True)
class Material:
    """Right messages, to be damaged."""

    submap: EncodedSubmap
    """Index 1."""
    zero: EncodedSubmap
    """The one before it."""
    lossless: bytes
    """The Gaussians in the other layout."""
    jpeg: bytes
    png: bytes
    depth_png: bytes
    size: tuple[int, int]
    archive: archive_pb2.SessionArchive
    folder: BlobFolder

    @classmethod
    def make(cls) -> Material:
        """From the small world."""
        submap = make_submap("fuzz", index=1)
        encoded = encode_submap(submap, request_id="first")
        folder = BlobFolder(Path(tempfile.mkdtemp(prefix="magic-fuzz-")))
        folder.open()
        colour = submap.anchor.colour
        zero = encode_submap(make_submap("fuzz"), request_id="zero")
        return cls(
            submap=encoded,
            zero=zero,
            lossless=codec.encode_lossless(submap.gaussians),
            jpeg=images.encode_colour_jpeg(colour),
            png=images.encode_colour_png(colour),
            depth_png=images.encode_depth_png(submap.anchor.depth),
            size=(submap.camera.width, submap.camera.height),
            archive=_archive(zero, encoded),
            folder=folder,
        )

    def header(self) -> submap_pb2.SubmapHeader:
        """A copy of the header."""
        return submap_pb2.SubmapHeader.FromString(self.submap.header.SerializeToString())


def _archive(*submaps: EncodedSubmap) -> archive_pb2.SessionArchive:
    archive = archive_pb2.SessionArchive()
    archive.session.name = "sessions/fuzz"
    archive.session.descriptor_model_id = MODEL_ID
    archive.session.descriptor_dimension = DIMENSION
    archive.agents.add(name="sessions/fuzz/agents/agent_0", state=1)
    for submap in submaps:
        archive.submaps.add(header=submap.header, searched=True)
    first, second = (submap.header.name for submap in submaps)
    archive.loops.add(source=second, target=first, similarity=0.5, verdict=3, reason="LOW_FITNESS")
    archive.snapshot.session, archive.snapshot.revision = "sessions/fuzz", 1
    for name in (first, second):
        pose = archive.snapshot.poses.add(submap=name, component=first)
        pose.world_from_anchor.qw = 1.0
    archive.snapshot.components.add(
        id=first, submap_count=2, agents=["sessions/fuzz/agents/agent_0"]
    )
    return archive


def check_header_bytes(material: Material, rng: random.Random) -> None:
    """A header whose bytes were damaged on the way."""
    header = submap_pb2.SubmapHeader()
    try:
        header.ParseFromString(mutated_bytes(material.submap.header.SerializeToString(), rng))
    except DecodeError as error:  # the interceptor's answer to it
        raise InvalidInput("not a message") from error
    _use(header)


def check_header_fields(material: Material, rng: random.Random) -> None:
    """A header with strange values in its fields."""
    header = material.header()
    mutate_message(header, rng)
    _use(header)


def _use(header: submap_pb2.SubmapHeader) -> None:
    """What the server does with a header before a byte of its blobs has come."""
    check_header(header, LIMITS)
    header.SerializeToString(deterministic=True)
    geometry.descriptor_from_proto(header.image_descriptor)
    decode_odometry(header)


def check_gaussians(material: Material, rng: random.Random) -> None:
    """A blob of Gaussians in either layout."""
    data = rng.choice((material.submap.blobs[0], material.lossless))
    _check(material, 0, mutated_frame(data, rng, header_bytes=12))


def check_depth(material: Material, rng: random.Random) -> None:
    """A depth image as agents send it."""
    _check(material, 2, mutated_frame(material.submap.blobs[2], rng, header_bytes=16))


def check_depth_png(material: Material, rng: random.Random) -> None:
    """A depth image as PNG."""
    data = mutated_png(material.depth_png, rng)
    images.check_image(data, images.PNG, size=material.size, depth=True)


def check_jpeg(material: Material, rng: random.Random) -> None:
    """A colour image as JPEG."""
    _check(material, 1, mutated_bytes(material.jpeg, rng))


def check_png(material: Material, rng: random.Random) -> None:
    """A colour image as PNG."""
    images.check_image(mutated_png(material.png, rng), images.PNG, size=material.size, depth=False)


def _check(material: Material, index: int, data: bytes) -> None:
    """Check a blob as the server does; what it accepts must also decode."""
    header = material.submap.header
    check_blob(header, index, data)
    blobs = list(material.submap.blobs)
    blobs[index] = data
    decode_submap(header, blobs)


def check_chunks(material: Material, rng: random.Random) -> None:
    """The chunks of an upload, one of them wrong, left out, doubled or moved."""
    blobs = material.submap.blobs
    chunks = [c for i, blob in enumerate(blobs) for c in chunks_of(blob, blob_index=i)]
    match rng.randrange(4):
        case 0:
            del chunks[rng.randrange(len(chunks))]
        case 1:
            chunks.insert(rng.randrange(len(chunks)), rng.choice(chunks))
        case _:
            mutate_message(rng.choice(chunks), rng)
    cursor = ChunkCursor(tuple(map(len, blobs)))
    for chunk in chunks:
        check_chunk(chunk)
        cursor.advance(chunk)
    if not cursor.done:
        raise InvalidInput("ended early")


def check_archives(material: Material, rng: random.Random) -> None:
    """An archive with damaged bytes, or with strange values and right checksums."""
    archive = archive_pb2.SessionArchive.FromString(material.archive.SerializeToString())
    blind = rng.random() < 0.3
    if not blind:
        mutate_message(archive, rng)
    data = archive_file(archive, material)
    if blind:
        data = mutated_bytes(data, rng)
    reader = ArchiveReader(material.folder, max_bytes=1 << 26)
    try:
        for begin in range(0, len(data), 7000):
            reader.feed(data[begin : begin + 7000])
        reader.finish()
        check_archive(reader.archive, reader.blobs, LIMITS)
    finally:
        reader.discard()
    assert not list(material.folder.incoming.iterdir())


def archive_file(archive: archive_pb2.SessionArchive, material: Material) -> bytes:
    """The bytes of an archive of this session."""
    blobs = {sha256(blob).hex(): blob for blob in (*material.zero.blobs, *material.submap.blobs)}
    session = archive.SerializeToString()
    contents = {SESSION: session} | {blob_path(digest): blob for digest, blob in blobs.items()}
    members = [Member(path, len(data), sha256(data).hex()) for path, data in contents.items()]
    manifest = manifest_of(members, session="sessions/fuzz", submaps=2)
    out = bytearray()
    for path, data in {MANIFEST: manifest, **contents}.items():
        out += tar_header(path, len(data)) + data + bytes(padding(len(data)))
    return bytes(out) + bytes(1024)


CHECKS: dict[str, Callable[[Material, random.Random], None]] = {
    "header_bytes": check_header_bytes,
    "header_fields": check_header_fields,
    "gaussians": check_gaussians,
    "header_bytes_2": check_header_bytes,
    "header_fields_2": check_header_fields,
    "depth": check_depth,
    "depth_png": check_depth_png,
    "jpeg": check_jpeg,
    "header_fields_3": check_header_fields,
    "png": check_png,
    "chunks": check_chunks,
    "archives": check_archives,
}
"""Each in turn."""
