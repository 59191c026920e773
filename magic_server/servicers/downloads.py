"""Stored files as streams of chunks."""

from __future__ import annotations

import asyncio
import hashlib
import zlib
from collections.abc import AsyncIterator
from concurrent.futures import Executor

from magicslam.v1 import submap_pb2

from magic_core.errors import CorruptData
from magic_core.wire import MAX_CHUNK_BYTES
from magic_server.store import BlobStore


async def file_chunks(
    blobs: BlobStore, sha256: str, threads: Executor, *, blob_index: int = 0
) -> AsyncIterator[submap_pb2.BlobChunk]:
    """A blob as chunk messages, read one at a time as the receiver takes them.

    Raises CorruptData before the last one when the file is not what its name says.
    """
    loop = asyncio.get_running_loop()
    digest = hashlib.sha256()

    def piece(offset: int) -> submap_pb2.BlobChunk | None:
        data = blobs.read_piece(sha256, offset, MAX_CHUNK_BYTES)
        digest.update(data)
        if len(data) < MAX_CHUNK_BYTES and digest.hexdigest() != sha256:
            raise CorruptData(blobs.damage(sha256))
        if not data:
            return None
        return submap_pb2.BlobChunk(
            blob_index=blob_index, offset=offset, data=data, crc32=zlib.crc32(data)
        )

    offset = 0
    while (chunk := await loop.run_in_executor(threads, piece, offset)) is not None:
        yield chunk
        offset += len(chunk.data)
