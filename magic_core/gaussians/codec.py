"""Gaussian clouds as bytes: a lossless layout and a compact, quantised one.

Both begin with a fixed header and hold one zstd frame; docs/wire-format.md gives every byte.
All numbers are little-endian. The layouts hold columns ("structure of arrays"), because equal
things next to each other compress best.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import zstandard

from magic_core import zstd_frame
from magic_core.errors import CorruptData, InvalidInput, ResourceExhausted
from magic_core.gaussians import compact
from magic_core.gaussians.cloud import GaussianCloud

MAGIC = b"MGSC"
VERSION = 1
LOSSLESS, PACKED, COMPACT = 0, 1, 2
"""Layouts; `PACKED` is the compact one of agents before 2026-11-22, which is read only."""
MAX_GAUSSIANS = 50_000_000

_HEADER = struct.Struct("<4sBBHI")  # magic, version, layout, reserved, count
LOSSLESS_BYTES, COMPACT_BYTES = 56, compact.BYTES  # per Gaussian
HEADER_BYTES, RANGES_BYTES = _HEADER.size, compact.RANGES_BYTES
LOSSLESS_COLUMNS = (3, 4, 3, 1, 3)


@dataclass(frozen=True, slots=True)
class CompactOptions:
    """What the compact layout may lose."""

    position_step_m: float = 0.0005
    """Grid that positions snap to, metres; the error per axis is at most half of it."""
    zstd_level: int = 6
    """1 (fast) to 19 (small)."""


DEFAULT_COMPACT = CompactOptions()


def encode_lossless(cloud: GaussianCloud, *, zstd_level: int = 3) -> bytes:
    """All five columns as float32, in order; decodes bit for bit."""
    columns = [array.astype("<f4").tobytes() for array in cloud.arrays()]
    return _pack(LOSSLESS, len(cloud), columns, level=zstd_level)


def encode_compact(cloud: GaussianCloud, options: CompactOptions = DEFAULT_COMPACT) -> bytes:
    """Quantised columns in Morton order; about a fifth of the lossless size.

    Positions are off by at most half a step per axis, scales by at most 2 % over a range of
    1:10,000, rotations by at most 2.3 degrees (0.7 on average), opacities by 1/512, colours by
    1/510 of their range. Positions that do not fit 2^21 steps per axis get a coarser step.
    """
    grid = compact.grid_of(cloud.means, options.position_step_m)
    log_scale = compact.range_of(compact.log_scales(cloud), 0.0, 0.0)
    colour = compact.range_of(cloud.colours, 0.0, 1.0)
    codes = compact.codes_of(cloud, grid, log_scale, colour)
    ranges = compact.pack_ranges(grid, log_scale, colour)
    columns = [ranges, *(column.tobytes() for column in codes.columns)]
    return _pack(COMPACT, len(cloud), columns, level=options.zstd_level)


def decode(data: bytes, *, max_gaussians: int = MAX_GAUSSIANS) -> GaussianCloud:
    """Either layout back to a cloud.

    Memory is bounded by the header's count, which is checked before anything is decompressed.
    Raises CorruptData when the bytes are not in the format, ResourceExhausted when there are more
    Gaussians than allowed, InvalidInput when a value is out of range.
    """
    layout, count = _read_header(data)
    if count > max_gaussians:
        raise ResourceExhausted(f"{count} Gaussians in one blob, at most {max_gaussians} allowed")
    if layout == LOSSLESS:
        cloud = _decode_lossless(_unpack(data, count * LOSSLESS_BYTES), count)
    else:
        payload = _unpack(data, RANGES_BYTES + count * COMPACT_BYTES)
        cloud = compact.cloud_of(payload, count, separate=layout == COMPACT)
    with np.errstate(over="ignore"):  # the norm of a damaged quaternion
        cloud.validate()
    return cloud


def check(data: bytes, *, max_gaussians: int = MAX_GAUSSIANS) -> int:
    """The number of Gaussians in a blob; raises where `decode` would, in a fifth of its time.

    What the compact layout can say wrong shows in its extremes: rotations and opacities of any code
    are right ones, positions, scales and colours grow with their codes.
    """
    layout, count = _read_header(data)
    if layout == LOSSLESS or not 0 < count <= max_gaussians:
        return len(decode(data, max_gaussians=max_gaussians))
    payload = _unpack(data, RANGES_BYTES + count * COMPACT_BYTES)
    with np.errstate(over="ignore"):
        compact.extremes_of(payload, count, separate=layout == COMPACT).validate()
    return count


def gaussian_count(data: bytes) -> int:
    """The number of Gaussians that the header claims; reads the first 12 bytes only."""
    return _read_header(data)[1]


def _read_header(data: bytes) -> tuple[int, int]:
    """(layout, count)."""
    if len(data) < _HEADER.size:
        raise CorruptData(f"Gaussian blob of {len(data)} bytes, the header alone is {_HEADER.size}")
    magic, version, layout, _, count = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise CorruptData(f"Gaussian blob starts with {magic!r}, expected {MAGIC!r}")
    if version != VERSION or layout not in (LOSSLESS, PACKED, COMPACT):
        raise CorruptData(
            f"Gaussian blob version {version}, layout {layout}: this build reads version "
            f"{VERSION}, layouts {LOSSLESS} to {COMPACT}; update the older side"
        )
    return layout, count


def header(layout: int, count: int) -> bytes:
    """The 12 bytes before the zstd frame; InvalidInput when there are too many Gaussians."""
    if count > MAX_GAUSSIANS:
        raise InvalidInput(f"{count} Gaussians in one blob, at most {MAX_GAUSSIANS} allowed")
    return _HEADER.pack(MAGIC, VERSION, layout, 0, count)


def _pack(layout: int, count: int, columns: Sequence[bytes], *, level: int) -> bytes:
    """One frame whose blocks end with the columns: each has statistics of its own."""
    size = sum(len(column) for column in columns)
    frame = zstandard.ZstdCompressor(level=level).compressobj(size=size)
    packed = [header(layout, count)]
    for column in columns:
        packed += frame.compress(column), frame.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    return b"".join([*packed, frame.flush()])


def _unpack(data: bytes, size: int) -> bytes:
    """The zstd frame's content, which must be exactly `size` bytes."""
    return zstd_frame.content_of(data[_HEADER.size :], size, what="Gaussian payload")


def _decode_lossless(payload: bytes, count: int) -> GaussianCloud:
    flat = np.frombuffer(payload, "<f4").astype(np.float32)
    ends = np.cumsum([0, *(count * width for width in LOSSLESS_COLUMNS)])
    parts = [flat[a:b] for a, b in itertools.pairwise(ends)]
    shapes = [count if width == 1 else (count, width) for width in LOSSLESS_COLUMNS]
    return GaussianCloud(*(p.reshape(shape) for p, shape in zip(parts, shapes, strict=True)))
