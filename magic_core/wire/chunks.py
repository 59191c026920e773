"""Blobs as sequences of checked chunks, and back."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator

from magicslam.v1 import submap_pb2

from magic_core.errors import CorruptData, InvalidInput

MAX_CHUNK_BYTES = 1 << 20


def chunks_of(
    data: bytes, *, blob_index: int = 0, chunk_bytes: int = MAX_CHUNK_BYTES, begin: int = 0
) -> Iterator[submap_pb2.BlobChunk]:
    """A blob, from byte `begin` on, as chunk messages in order, each with offset and CRC-32."""
    for offset in range(begin, len(data), chunk_bytes):
        piece = data[offset : offset + chunk_bytes]
        yield submap_pb2.BlobChunk(
            blob_index=blob_index, offset=offset, data=piece, crc32=zlib.crc32(piece)
        )


def check_chunk(chunk: submap_pb2.BlobChunk, *, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> None:
    """Raise InvalidInput for a wrong size, CorruptData for a wrong checksum."""
    if not 1 <= len(chunk.data) <= max_chunk_bytes:
        rule = f"{len(chunk.data)} bytes, expected 1 to {max_chunk_bytes}"
        raise InvalidInput.field("chunk.data", rule)
    if zlib.crc32(chunk.data) != chunk.crc32:
        raise CorruptData(
            f"chunk at offset {chunk.offset} of blob {chunk.blob_index}: its CRC-32 does not "
            "match; send it again"
        )


def sha256(data: bytes) -> bytes:
    """The 32-byte digest that names a blob."""
    return hashlib.sha256(data).digest()


class ChunkCursor:
    """Follows the chunks of the blobs of one header: order, gaps, lengths.

    It holds no bytes; whoever writes them does. `position` is (blob index, next offset).
    """

    __slots__ = ("_blob", "_lengths", "_offset")

    def __init__(self, lengths: tuple[int, ...]) -> None:
        self._lengths = lengths
        self._blob = 0
        self._offset = 0

    @property
    def position(self) -> tuple[int, int]:
        """(blob index, offset) that the next chunk must have."""
        return self._blob, self._offset

    @property
    def done(self) -> bool:
        """True when every blob is complete."""
        return self._blob == len(self._lengths)

    def advance(self, chunk: submap_pb2.BlobChunk) -> bool:
        """Step over a chunk; True when it completes its blob. InvalidInput when out of place."""
        if self.done:
            raise InvalidInput.field("chunk", "every blob is complete already")
        if (chunk.blob_index, chunk.offset) != self.position:
            raise InvalidInput.field(
                "chunk.offset",
                f"chunk of blob {chunk.blob_index} at {chunk.offset}, expected blob {self._blob} "
                f"at {self._offset}: blobs follow the header's order without gaps",
            )
        length = self._lengths[self._blob]
        if self._offset + len(chunk.data) > length:
            raise InvalidInput.field(
                "chunk.data", f"blob {self._blob} would exceed the {length} bytes of its header"
            )
        self._offset += len(chunk.data)
        if self._offset < length:
            return False
        self._blob, self._offset = self._blob + 1, 0
        return True


def joined(chunks: list[submap_pb2.BlobChunk], *, expected_sha256: bytes) -> bytes:
    """The blob of all its chunks; CorruptData when the digest differs."""
    data = b"".join(chunk.data for chunk in chunks)
    if sha256(data) != expected_sha256:
        raise CorruptData(f"{len(data)} bytes received, their SHA-256 does not match; fetch again")
    return data
