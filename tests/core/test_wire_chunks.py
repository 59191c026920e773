"""Chunks: order, gaps, sizes and checksums."""

from __future__ import annotations

import pytest

from magic_core.errors import CorruptData, InvalidInput
from magic_core.wire import MAX_CHUNK_BYTES, ChunkCursor, check_chunk, chunks_of

DATA = bytes(range(256)) * 10


def test_chunks_join_to_the_blob() -> None:
    chunks = list(chunks_of(DATA, blob_index=3, chunk_bytes=1000))
    assert [chunk.offset for chunk in chunks] == [0, 1000, 2000]
    assert {chunk.blob_index for chunk in chunks} == {3}
    assert b"".join(chunk.data for chunk in chunks) == DATA
    for chunk in chunks:
        check_chunk(chunk)


def test_a_flipped_bit_is_corrupt() -> None:
    chunk = next(chunks_of(DATA))
    chunk.data = bytes([chunk.data[0] ^ 1]) + chunk.data[1:]
    with pytest.raises(CorruptData):
        check_chunk(chunk)


def test_an_empty_or_oversized_chunk_is_invalid() -> None:
    chunk = next(chunks_of(bytes(MAX_CHUNK_BYTES + 1), chunk_bytes=MAX_CHUNK_BYTES + 1))
    with pytest.raises(InvalidInput):
        check_chunk(chunk)
    chunk.data = b""
    with pytest.raises(InvalidInput):
        check_chunk(chunk)


def test_the_cursor_follows_several_blobs() -> None:
    cursor = ChunkCursor((2500, 10))
    steps = [*chunks_of(DATA[:2500], chunk_bytes=1000), *chunks_of(DATA[:10], blob_index=1)]
    assert [cursor.advance(chunk) for chunk in steps] == [False, False, True, True]
    assert cursor.done


@pytest.mark.parametrize(
    "order", [[1], [0, 2], [0, 0], [0, 1, 2, 2]], ids=["late", "gap", "repeat", "beyond"]
)
def test_the_cursor_refuses_chunks_out_of_place(order: list[int]) -> None:
    chunks = list(chunks_of(DATA, chunk_bytes=1000))
    cursor = ChunkCursor((len(DATA),))
    for index in order[:-1]:
        cursor.advance(chunks[index])
    with pytest.raises(InvalidInput):
        cursor.advance(chunks[order[-1]])


def test_the_cursor_refuses_more_than_the_header_said() -> None:
    with pytest.raises(InvalidInput, match="exceed"):
        ChunkCursor((100,)).advance(next(chunks_of(DATA)))
