"""Depth images as differences along rows, in byte planes: smaller than PNG, and as lossless.

A 16-byte header and one zstd frame; docs/wire-format.md gives every byte. A sensor that measures
disparity knows few depths: where an image has few, their ranks are stored, which differ by little
from pixel to pixel.
"""

from __future__ import annotations

import struct

import numpy as np
import zstandard
from numpy.typing import NDArray

from magic_core import zstd_frame
from magic_core.errors import CorruptData, InvalidInput

MEDIA_TYPE = "application/vnd.magicslam.depth"
MAGIC, VERSION = b"MGSD", 1
MAX_LEVELS = 1024
"""With more depths than this in an image, their ranks are no smaller than the depths."""
ZSTD_LEVEL = 9
_HEADER = struct.Struct("<4sBBHII")  # magic, version, 0, levels, width, height


def encode(units: NDArray[np.uint16]) -> bytes:
    """(h, w) depths in units, 0 = no reading."""
    height, width = units.shape
    present = np.zeros(1 << 16, bool)
    present[units] = True
    levels = np.flatnonzero(present).astype("<u2")
    if len(levels) > MAX_LEVELS:
        levels = levels[:0]
    else:
        ranks = np.cumsum(present, dtype=np.uint32) - np.uint32(1)
        units = ranks.astype(np.uint16)[units]
    steps = np.diff(units, axis=1, prepend=np.uint16(0)).view(np.int16)
    codes = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    planes = [(codes & 0xFF).astype(np.uint8), (codes >> 8).astype(np.uint8)]
    content = b"".join([levels.tobytes(), *(plane.tobytes() for plane in planes)])
    header = _HEADER.pack(MAGIC, VERSION, 0, len(levels), width, height)
    return header + zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(content)


def read_size(data: bytes) -> tuple[int, int]:
    """(width, height) by the header; CorruptData when it is none of this format."""
    _, width, height = _read_header(data)
    return width, height


def decode(data: bytes) -> NDArray[np.uint16]:
    """(h, w) depths in units. Check `read_size` first: it says how much memory is needed.

    Raises CorruptData when the bytes are not in the format, InvalidInput for another version.
    """
    levels, width, height = _read_header(data)
    size = 2 * (levels + width * height)
    content = zstd_frame.content_of(data[_HEADER.size :], size, what="the depth image")
    table = np.frombuffer(content, "<u2", levels).astype(np.uint16)
    planes = np.frombuffer(content, np.uint8, offset=2 * levels).reshape(2, height, width)
    codes = planes[0] | (planes[1].astype(np.uint16) << 8)
    # Differences and their sums are those of 16-bit numbers, which overflow as they do.
    steps = (codes >> 1) ^ (0 - (codes & 1)).astype(np.uint16)
    units = np.cumsum(steps, axis=1, dtype=np.uint16)
    if not levels:
        return units
    if (table[1:] <= table[:-1]).any():
        raise CorruptData("the depths of the depth image's table do not increase")
    if units.max(initial=0) >= levels:
        raise CorruptData(f"the depth image refers to more depths than its table of {levels} has")
    return table[units]


def _read_header(data: bytes) -> tuple[int, int, int]:
    if len(data) < _HEADER.size or data[:4] != MAGIC:
        raise CorruptData(f"not a depth image: it does not begin with {MAGIC.decode()}")
    _, version, reserved, levels, width, height = _HEADER.unpack_from(data)
    if version != VERSION:
        raise InvalidInput(f"depth image of version {version}, this release reads {VERSION}")
    if reserved or levels > MAX_LEVELS or not width or not height:
        raise CorruptData("the depth image's header holds values that have no meaning")
    return levels, width, height
