"""Open files as streams of chunks."""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import AsyncIterator
from concurrent.futures import Executor

from magicslam.v1 import submap_pb2

from magic_core.wire import MAX_CHUNK_BYTES
from magic_server.jobs.delivery import OpenFile


async def open_chunks(file: OpenFile, threads: Executor) -> AsyncIterator[submap_pb2.BlobChunk]:
    """An open file as chunk messages, read one at a time as the receiver takes them."""
    loop = asyncio.get_running_loop()

    def piece(offset: int) -> submap_pb2.BlobChunk | None:
        data = file.read(MAX_CHUNK_BYTES)
        if not data:
            return None
        return submap_pb2.BlobChunk(offset=offset, data=data, crc32=zlib.crc32(data))

    offset = 0
    while (chunk := await loop.run_in_executor(threads, piece, offset)) is not None:
        yield chunk
        offset += len(chunk.data)
