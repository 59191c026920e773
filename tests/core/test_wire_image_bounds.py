"""An image that would take much to decode is refused by its first bytes."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from magic_core.errors import InvalidInput, MagicError
from magic_core.wire import images


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb_png(width: int, height: int, *, depth: bool = False) -> bytes:
    """A few bytes that decode to width x height pixels."""
    row = bytes(1 + width * (2 if depth else 3))
    body = zlib.compressobj(9)
    pixels = b"".join(body.compress(row) for _ in range(height)) + body.flush()
    header = struct.pack(">IIBBBBB", width, height, 16 if depth else 8, 0 if depth else 2, 0, 0, 0)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", pixels) + png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.mark.parametrize("depth", [False, True])
def test_a_decompression_bomb_is_refused_before_it_is_decoded(depth: bool) -> None:
    data = bomb_png(5000, 5000, depth=depth)
    assert len(data) < 100_000
    tracemalloc.start()
    with pytest.raises(InvalidInput, match="5000x5000, the camera says 64x48"):
        images.check_image(data, images.PNG, size=(64, 48), depth=depth)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def test_an_image_above_the_limit_is_refused_whatever_the_camera_says() -> None:
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", b"")
    with pytest.raises(InvalidInput, match="at most 64000000 pixels"):
        images.check_image(data, images.PNG, size=(60_000, 60_000), depth=False)


def test_a_jpeg_of_many_scans_is_refused_and_an_ordinary_progressive_one_is_not() -> None:
    image = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    data = cv2.imencode(".jpg", image, flags)[1].tobytes()
    assert data.count(b"\xff\xda") > 1
    images.check_image(data, images.JPEG, size=(64, 48), depth=False)
    start = data.index(b"\xff\xda")
    end = data.index(b"\xff\xda", start + 2)
    with pytest.raises(InvalidInput, match="scans, at most 100"):
        images.check_image(
            data[:end] + data[start:end] * 200 + data[end:], images.JPEG, size=(64, 48), depth=False
        )


def test_an_animated_png_is_refused_and_endless_chunks_are() -> None:
    data = images.encode_colour_png(np.zeros((48, 64, 3), np.uint8))
    animated = data[:33] + png_chunk(b"acTL", struct.pack(">II", 1, 0)) + data[33:]
    with pytest.raises(InvalidInput, match="animated"):
        images.check_image(animated, images.PNG, size=(64, 48), depth=False)
    padded = data[:33] + png_chunk(b"tEXt", b"a\0b") * 200 + data[33:]
    with pytest.raises(MagicError, match="100 chunks"):
        images.check_image(padded, images.PNG, size=(64, 48), depth=False)
