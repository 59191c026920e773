"""Gaussian clouds as bytes: a lossless layout and a compact, quantised one.

Both begin with a fixed header and hold one zstd frame; docs/wire-format.md gives every byte.
All numbers are little-endian. The layouts hold columns ("structure of arrays"), because equal
things next to each other compress best.
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

from magic_core import zstd_frame
from magic_core.errors import CorruptData, InvalidInput, ResourceExhausted
from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.morton import BITS, morton_codes

MAGIC = b"MGSC"
VERSION = 1
LOSSLESS, COMPACT = 0, 1
MAX_GAUSSIANS = 50_000_000

_HEADER = struct.Struct("<4sBBHI")  # magic, version, layout, reserved, count
_RANGES = struct.Struct("<3dd2f2f")  # origin xyz, step, log-scale range, colour range
LOSSLESS_BYTES, COMPACT_BYTES = 56, 23  # per Gaussian
HEADER_BYTES, RANGES_BYTES = _HEADER.size, _RANGES.size
LOSSLESS_COLUMNS = (3, 4, 3, 1, 3)
MAX_GRID = 2**BITS - 1
_QUATERNION_LEVELS = 1023
_SQRT_HALF = 0.5**0.5


@dataclass(frozen=True, slots=True)
class CompactOptions:
    """What the compact layout may lose."""

    position_step_m: float = 0.0005
    """Grid that positions snap to, metres; the error per axis is at most half of it."""
    zstd_level: int = 6
    """1 (fast) to 19 (small)."""


DEFAULT_COMPACT = CompactOptions()


@dataclass(frozen=True, slots=True)
class Grid:
    """Where positions snap to."""

    origin: NDArray[np.float64]  # (3,) metres
    step: float
    """Metres."""


@dataclass(frozen=True, slots=True)
class CompactCodes:
    """A cloud in the codes of the compact layout."""

    columns: list[NDArray[np.uint8]]
    """23 columns of n bytes, in the layout's order."""
    last: NDArray[np.int64]
    """(1, 3) grid coordinates of the last Gaussian, from which a next piece goes on."""


def encode_lossless(cloud: GaussianCloud, *, zstd_level: int = 3) -> bytes:
    """All five columns as float32, in order; decodes bit for bit."""
    columns = b"".join(array.astype("<f4").tobytes() for array in cloud.arrays())
    return _pack(LOSSLESS, len(cloud), columns, zstd_level)


def encode_compact(cloud: GaussianCloud, options: CompactOptions = DEFAULT_COMPACT) -> bytes:
    """Quantised columns in Morton order; about a quarter of the lossless size.

    Positions are off by at most half a step per axis, scales by at most 2 % over a range of
    1:10,000, rotations by at most 0.25 degrees, opacities by 1/512, colours by 1/510 of their
    range. Positions that do not fit 2^21 steps per axis get a coarser step.
    """
    grid = _position_grid(cloud.means, options.position_step_m)
    log_scale = _range(_log_scales(cloud), 0.0, 0.0)
    colour = _range(cloud.colours, 0.0, 1.0)
    codes = compact_codes(cloud, grid, log_scale, colour, after=np.zeros((1, 3), np.int64))
    ranges = pack_ranges(grid, log_scale, colour)
    payload = b"".join([ranges, *(column.tobytes() for column in codes.columns)])
    return _pack(COMPACT, len(cloud), payload, options.zstd_level)


def pack_ranges(grid: Grid, log_scale: tuple[float, float], colour: tuple[float, float]) -> bytes:
    """The 48 bytes that say what the compact codes mean."""
    return _RANGES.pack(*grid.origin, grid.step, *log_scale, *colour)


def compact_codes(
    cloud: GaussianCloud,
    grid: Grid,
    log_scale: tuple[float, float],
    colour: tuple[float, float],
    *,
    after: NDArray[np.int64],
) -> CompactCodes:
    """A cloud in Morton order as columns of bytes; its first position is coded from `after`."""
    places = np.rint((cloud.means.astype(np.float64) - grid.origin) / grid.step).astype(np.int64)
    order = np.argsort(morton_codes(places), kind="stable")
    places, cloud = places[order], cloud.select(order)
    deltas = _zigzag(np.diff(places, axis=0, prepend=after))
    opacity = np.clip(cloud.opacities.astype(np.float64) * 256.0, 0.0, 255.0).astype(np.uint8)
    n = len(cloud)
    columns = [
        *np.frombuffer(_planes(deltas.T), np.uint8).reshape(12, n),
        *np.frombuffer(_planes(_quaternion_codes(cloud.quaternions)), np.uint8).reshape(4, n),
        *_to_bytes(_log_scales(cloud), log_scale).T,
        opacity,
        *_to_bytes(cloud.colours, colour).T,
    ]
    return CompactCodes(columns, places[-1:] if n else after)


def _log_scales(cloud: GaussianCloud) -> NDArray[np.float64]:
    return np.log(np.maximum(cloud.scales.astype(np.float64), 1e-12))


def decode(data: bytes, *, max_gaussians: int = MAX_GAUSSIANS) -> GaussianCloud:
    """Either layout back to a cloud.

    Memory is bounded by the header's count, which is checked before anything is decompressed.
    Raises CorruptData when the bytes are not in the format, ResourceExhausted when there are more
    Gaussians than allowed, InvalidInput when a value is out of range.
    """
    layout, count = _read_header(data)
    if count > max_gaussians:
        raise ResourceExhausted(f"{count} Gaussians in one blob, at most {max_gaussians} allowed")
    size = count * LOSSLESS_BYTES
    if layout == COMPACT:
        size = _RANGES.size + count * COMPACT_BYTES
    payload = _unpack(data, size)
    cloud = (_decode_lossless if layout == LOSSLESS else _decode_compact)(payload, count)
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
    payload = _unpack(data, _RANGES.size + count * COMPACT_BYTES)
    ranges = _read_ranges(payload)
    raw = np.frombuffer(payload, np.uint8, offset=_RANGES.size)
    grid = np.cumsum(_unzigzag(_from_planes(raw[: 12 * count], (3, count))), axis=1)
    corners = np.stack([grid.min(axis=1), grid.max(axis=1)])
    scales, colours = raw[16 * count : 19 * count], raw[20 * count :]
    with np.errstate(over="ignore"):
        extremes = GaussianCloud.from_arrays(
            corners * ranges.step + np.array(ranges.origin),
            np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
            scales=np.exp(_from_bytes(_extremes(scales), ranges.scale)),
            opacities=np.full(2, 0.5),
            colours=_from_bytes(_extremes(colours), ranges.colour),
        )
        extremes.validate()
    return count


def _extremes(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Lowest and highest code, (2, 3)."""
    return np.repeat(np.array([codes.min(), codes.max()])[:, None], 3, axis=1)


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
    if version != VERSION or layout not in (LOSSLESS, COMPACT):
        raise CorruptData(
            f"Gaussian blob version {version}, layout {layout}: this build reads version "
            f"{VERSION}, layouts {LOSSLESS} and {COMPACT}; update the older side"
        )
    return layout, count


def header(layout: int, count: int) -> bytes:
    """The 12 bytes before the zstd frame; InvalidInput when there are too many Gaussians."""
    if count > MAX_GAUSSIANS:
        raise InvalidInput(f"{count} Gaussians in one blob, at most {MAX_GAUSSIANS} allowed")
    return _HEADER.pack(MAGIC, VERSION, layout, 0, count)


def _pack(layout: int, count: int, payload: bytes, level: int) -> bytes:
    return header(layout, count) + zstandard.ZstdCompressor(level=level).compress(payload)


def _unpack(data: bytes, size: int) -> bytes:
    """The zstd frame's content, which must be exactly `size` bytes."""
    return zstd_frame.content_of(data[_HEADER.size :], size, what="Gaussian payload")


def _decode_lossless(payload: bytes, count: int) -> GaussianCloud:
    flat = np.frombuffer(payload, "<f4").astype(np.float32)
    ends = np.cumsum([0, *(count * width for width in LOSSLESS_COLUMNS)])
    parts = [flat[a:b] for a, b in itertools.pairwise(ends)]
    shapes = [count if width == 1 else (count, width) for width in LOSSLESS_COLUMNS]
    return GaussianCloud(*(p.reshape(shape) for p, shape in zip(parts, shapes, strict=True)))


@dataclass(frozen=True, slots=True)
class _Ranges:
    """What the codes of a compact blob mean."""

    origin: tuple[float, float, float]
    step: float
    scale: tuple[float, float]
    colour: tuple[float, float]


def _read_ranges(payload: bytes) -> _Ranges:
    ox, oy, oz, step, scale_lo, scale_hi, colour_lo, colour_hi = _RANGES.unpack_from(payload)
    if not np.isfinite([ox, oy, oz, step, scale_lo, scale_hi, colour_lo, colour_hi]).all():
        raise InvalidInput.field("gaussians.ranges", "holds NaN or infinity")
    return _Ranges((ox, oy, oz), step, (scale_lo, scale_hi), (colour_lo, colour_hi))


def _decode_compact(payload: bytes, count: int) -> GaussianCloud:
    ranges = _read_ranges(payload)
    raw = np.frombuffer(payload, np.uint8, offset=_RANGES.size)
    deltas, raw = raw[: 12 * count], raw[12 * count :]
    codes, raw = raw[: 4 * count], raw[4 * count :]
    scales, raw = raw[: 3 * count], raw[3 * count :]
    opacities, colours = raw[:count], raw[count:]
    grid = np.cumsum(_unzigzag(_from_planes(deltas, (3, count))), axis=1, dtype=np.int64)
    means = grid.T * ranges.step + np.array(ranges.origin)
    with np.errstate(over="ignore"):
        return GaussianCloud.from_arrays(
            means,
            _quaternions_of_codes(_from_planes(codes, (count,))),
            scales=np.exp(_from_bytes(scales.reshape(3, count).T, ranges.scale)),
            opacities=(opacities.astype(np.float64) + 0.5) / 256.0,
            colours=_from_bytes(colours.reshape(3, count).T, ranges.colour),
        )


def _position_grid(means: NDArray[np.float32], step: float) -> Grid:
    if len(means) == 0:
        return Grid(np.zeros(3), step)
    points = means.astype(np.float64)
    origin = points.min(axis=0)
    return Grid(origin, max(step, float((points.max(axis=0) - origin).max()) / MAX_GRID))


def _zigzag(values: NDArray) -> NDArray[np.uint32]:
    """Signed to unsigned so that small magnitudes have small codes."""
    return ((values << 1) ^ (values >> 63)).astype(np.uint32)


def _unzigzag(codes: NDArray[np.uint32]) -> NDArray[np.int64]:
    wide = codes.astype(np.int64)
    return (wide >> 1) ^ -(wide & 1)


def _planes(values: NDArray[np.uint32]) -> bytes:
    """The bytes of the values, all lowest bytes first: the high planes compress to nothing."""
    flat = np.ascontiguousarray(values, "<u4").reshape(-1)
    return flat.view(np.uint8).reshape(-1, 4).T.tobytes()


def _from_planes(data: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint32]:
    return np.ascontiguousarray(data.reshape(4, -1).T).view("<u4").reshape(shape)


def _range(values: NDArray, low: float, high: float) -> tuple[float, float]:
    """The values' range as float32 numbers, at least (low, high) where those differ."""
    if values.size == 0:
        return low, high
    found = (float(values.min()), float(values.max()))
    found = (min(low, found[0]), max(high, found[1])) if low != high else found
    return tuple(np.array(found, np.float32).tolist())


def _to_bytes(values: NDArray, limits: tuple[float, float]) -> NDArray[np.uint8]:
    low, high = limits
    unit = (values.astype(np.float64) - low) / max(high - low, 1e-30)
    return np.rint(np.clip(unit, 0.0, 1.0) * 255.0).astype(np.uint8)


def _from_bytes(codes: NDArray[np.uint8], limits: tuple[float, float]) -> NDArray[np.float64]:
    low, high = limits
    return low + codes.astype(np.float64) * ((high - low) / 255.0)


def _quaternion_codes(quaternions: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Smallest three: 2 bits say which component is left out, 10 bits for each other one."""
    q = quaternions.astype(np.float64)
    if len(q) == 0:
        return np.zeros(0, np.uint32)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    largest = np.abs(q).argmax(axis=1)
    q *= np.where(np.take_along_axis(q, largest[:, None], axis=1) < 0, -1.0, 1.0)
    rest = np.take_along_axis(q, _OTHERS[largest], axis=1)
    unit = (rest / _SQRT_HALF + 1.0) / 2.0
    levels = np.rint(np.clip(unit, 0.0, 1.0) * _QUATERNION_LEVELS).astype(np.uint32)
    return largest.astype(np.uint32) << 30 | levels[:, 0] << 20 | levels[:, 1] << 10 | levels[:, 2]


def _quaternions_of_codes(codes: NDArray[np.uint32]) -> NDArray[np.float64]:
    largest = (codes >> 30).astype(np.int64)
    levels = np.stack([codes >> 20 & 1023, codes >> 10 & 1023, codes & 1023], axis=-1)
    rest = (levels.astype(np.float64) / _QUATERNION_LEVELS * 2.0 - 1.0) * _SQRT_HALF
    missing = np.sqrt(np.maximum(1.0 - (rest**2).sum(axis=1), 0.0))
    q = np.empty((len(codes), 4))
    np.put_along_axis(q, _OTHERS[largest], rest, axis=1)
    np.put_along_axis(q, largest[:, None], missing[:, None], axis=1)
    return q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
