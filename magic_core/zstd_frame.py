"""The one zstd frame that our blobs hold, read without spending more than its header says."""

from __future__ import annotations

import zstandard

from magic_core.errors import CorruptData


def content_of(frame: bytes, size: int, *, what: str) -> bytes:
    """The content of a zstd frame (RFC 8878) that must be exactly `size` bytes, and say so.

    Raises CorruptData, naming `what` holds the frame, when it is anything else or followed by more.
    """
    try:
        if zstandard.frame_content_size(frame) != size:
            raise CorruptData(f"{what} does not hold the {size} bytes its header needs")
        content = zstandard.ZstdDecompressor().decompress(
            frame, max_output_size=size, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise CorruptData(f"{what} is not a zstd frame: {error}") from error
    if len(content) != size:
        raise CorruptData(f"{what} is {len(content)} bytes, its header needs {size}")
    return content
