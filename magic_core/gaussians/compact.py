"""The compact layout of a Gaussian blob: quantised columns of bytes, Gaussians in Morton order.

Neighbours in space stand next to each other, so that what changes slowly, positions and colours,
is told as differences. Each code has bytes of its own where it can: zstd learns one set of
frequencies for each column. docs/wire-format.md gives every byte, also of the layout that was
written before, which packed a rotation's levels into one number.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import CorruptData, InvalidInput
from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.morton import BITS, morton_codes

BYTES = 23
"""Of one Gaussian, before compression."""
MAX_GRID = 2**BITS - 1

_RANGES = struct.Struct("<3dd2f2f")  # origin xyz, step, log-scale range, colour range
RANGES_BYTES = _RANGES.size
_LEVELS, _PACKED_LEVELS = 127, 1023
_SQRT_HALF = 0.5**0.5
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


@dataclass(frozen=True, slots=True)
class Grid:
    """Where positions snap to."""

    origin: NDArray[np.float64]  # (3,) metres
    step: float
    """Metres."""


@dataclass(frozen=True, slots=True)
class Last:
    """The last Gaussian of a piece, from which the next piece goes on."""

    place: NDArray[np.int64] = field(default_factory=lambda: np.zeros((1, 3), np.int64))
    colour: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((3, 1), np.uint8))


@dataclass(frozen=True, slots=True)
class Codes:
    """A cloud in codes."""

    columns: list[NDArray[np.uint8]]
    """23 columns of n bytes, in the layout's order."""
    last: Last


@dataclass(frozen=True, slots=True)
class _Ranges:
    """What the codes of a blob mean."""

    origin: tuple[float, float, float]
    step: float
    scale: tuple[float, float]
    colour: tuple[float, float]


def grid_of(means: NDArray[np.float32], step: float) -> Grid:
    """The grid of a cloud; coarser than `step` metres only where 2^21 steps do not span it."""
    if len(means) == 0:
        return Grid(np.zeros(3), step)
    points = means.astype(np.float64)
    origin = points.min(axis=0)
    return Grid(origin, max(step, float((points.max(axis=0) - origin).max()) / MAX_GRID))


def log_scales(cloud: GaussianCloud) -> NDArray[np.float64]:
    """(n, 3) natural logarithms."""
    return np.log(np.maximum(cloud.scales.astype(np.float64), 1e-12))


def range_of(values: NDArray, low: float, high: float) -> tuple[float, float]:
    """The values' range as float32 numbers, at least (low, high) where those differ."""
    if values.size == 0:
        return low, high
    found = (float(values.min()), float(values.max()))
    found = (min(low, found[0]), max(high, found[1])) if low != high else found
    return tuple(np.array(found, np.float32).tolist())


def pack_ranges(grid: Grid, log_scale: tuple[float, float], colour: tuple[float, float]) -> bytes:
    """The 48 bytes that say what the codes mean."""
    return _RANGES.pack(*grid.origin, grid.step, *log_scale, *colour)


def codes_of(
    cloud: GaussianCloud,
    grid: Grid,
    log_scale: tuple[float, float],
    colour: tuple[float, float],
    *,
    after: Last | None = None,
) -> Codes:
    """A cloud in Morton order as columns of bytes, coded on from the end of the piece before."""
    after = after or Last()
    places = np.rint((cloud.means.astype(np.float64) - grid.origin) / grid.step).astype(np.int64)
    order = np.argsort(morton_codes(places), kind="stable")
    places, cloud = places[order], cloud.select(order)
    deltas = _zigzag(np.diff(places, axis=0, prepend=after.place))
    opacity = np.clip(cloud.opacities.astype(np.float64) * 256.0, 0.0, 255.0).astype(np.uint8)
    red, green, blue = _to_bytes(cloud.colours, colour).T
    mixed = np.stack([green, red - green, blue - green])  # modulo 256, as bytes are
    n = len(cloud)
    columns = [
        *np.frombuffer(_planes(deltas.T), np.uint8).reshape(12, n),
        *_rotation_codes(cloud.quaternions),
        *_to_bytes(log_scales(cloud), log_scale).T,
        opacity,
        *np.diff(mixed, axis=1, prepend=after.colour),
    ]
    return Codes(columns, Last(places[-1:], mixed[:, -1:]) if n else after)


def cloud_of(payload: bytes, count: int, *, separate: bool) -> GaussianCloud:
    """The cloud of a blob's content, which is as long as its count needs.

    Raises CorruptData where a rotation's code is none, InvalidInput where a range is not finite.
    """
    ranges, raw = _parts(payload, count)
    grid = _grid_places(raw, count)
    decode = _quaternions if separate else _packed_quaternions
    with np.errstate(over="ignore"):
        return GaussianCloud.from_arrays(
            grid.T * ranges.step + np.array(ranges.origin),
            decode(raw[12:16]),
            scales=np.exp(_from_bytes(raw[16:19].T, ranges.scale)),
            opacities=(raw[19].astype(np.float64) + 0.5) / 256.0,
            colours=_from_bytes(_colour_codes(raw, separate=separate).T, ranges.colour),
        )


def extremes_of(payload: bytes, count: int, *, separate: bool) -> GaussianCloud:
    """Two Gaussians with the lowest and the highest values that a blob of at least one has.

    What the layout can say wrong shows in them: opacities of any code are right ones; positions,
    scales and colours grow with their codes. Rotations are checked one by one.
    """
    ranges, raw = _parts(payload, count)
    grid = _grid_places(raw, count)
    if separate:
        _check_rotations(raw[12:16])
    corners = np.stack([grid.min(axis=1), grid.max(axis=1)])
    with np.errstate(over="ignore"):
        return GaussianCloud.from_arrays(
            corners * ranges.step + np.array(ranges.origin),
            np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
            scales=np.exp(_from_bytes(_extremes(raw[16:19]), ranges.scale)),
            opacities=np.full(2, 0.5),
            colours=_from_bytes(_extremes(_colour_codes(raw, separate=separate)), ranges.colour),
        )


def _parts(payload: bytes, count: int) -> tuple[_Ranges, NDArray[np.uint8]]:
    """What the codes mean, and the columns (23, n)."""
    ox, oy, oz, step, scale_lo, scale_hi, colour_lo, colour_hi = _RANGES.unpack_from(payload)
    if not np.isfinite([ox, oy, oz, step, scale_lo, scale_hi, colour_lo, colour_hi]).all():
        raise InvalidInput.field("gaussians.ranges", "holds NaN or infinity")
    ranges = _Ranges((ox, oy, oz), step, (scale_lo, scale_hi), (colour_lo, colour_hi))
    return ranges, np.frombuffer(payload, np.uint8, offset=RANGES_BYTES).reshape(BYTES, count)


def _grid_places(raw: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """(3, n) grid coordinates."""
    return np.cumsum(_unzigzag(_from_planes(raw[:12], (3, count))), axis=1, dtype=np.int64)


def _colour_codes(raw: NDArray[np.uint8], *, separate: bool) -> NDArray[np.uint8]:
    """(3, n) codes of red, green and blue."""
    if not separate:
        return raw[20:]
    green, red, blue = np.cumsum(raw[20:], axis=1, dtype=np.uint8)
    return np.stack([red + green, green, blue + green])


def _extremes(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Lowest and highest code, (2, 3)."""
    return np.repeat(np.array([codes.min(), codes.max()])[:, None], 3, axis=1)


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


def _to_bytes(values: NDArray, limits: tuple[float, float]) -> NDArray[np.uint8]:
    low, high = limits
    unit = (values.astype(np.float64) - low) / max(high - low, 1e-30)
    return np.rint(np.clip(unit, 0.0, 1.0) * 255.0).astype(np.uint8)


def _from_bytes(codes: NDArray[np.uint8], limits: tuple[float, float]) -> NDArray[np.float64]:
    low, high = limits
    return low + codes.astype(np.float64) * ((high - low) / 255.0)


def _rotation_codes(quaternions: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(4, n) smallest three: which component is left out, and a level for each other one."""
    q = quaternions.astype(np.float64)
    if len(q) == 0:
        return np.zeros((4, 0), np.uint8)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    largest = np.abs(q).argmax(axis=1)
    q *= np.where(np.take_along_axis(q, largest[:, None], axis=1) < 0, -1.0, 1.0)
    rest = np.take_along_axis(q, _OTHERS[largest], axis=1)
    unit = (rest / _SQRT_HALF + 1.0) / 2.0
    levels = np.rint(np.clip(unit, 0.0, 1.0) * _LEVELS)
    return np.vstack([largest, levels.T]).astype(np.uint8)


def _check_rotations(codes: NDArray[np.uint8]) -> None:
    if codes.size and (codes[0].max() > 3 or codes[1:].max() > _LEVELS):
        raise CorruptData("a rotation's code is beyond component 3 or level 127")


def _quaternions(codes: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(n, 4) of rotation codes (4, n)."""
    _check_rotations(codes)
    return _completed(codes[0].astype(np.int64), codes[1:].T, _LEVELS)


def _packed_quaternions(planes: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(n, 4) of 32-bit codes as byte planes (4, n): 2 bits for the component, 10 for a level."""
    codes = _from_planes(planes, (planes.shape[1],))
    levels = np.stack([codes >> 20 & 1023, codes >> 10 & 1023, codes & 1023], axis=-1)
    return _completed((codes >> 30).astype(np.int64), levels, _PACKED_LEVELS)


def _completed(largest: NDArray[np.int64], levels: NDArray, most: int) -> NDArray[np.float64]:
    """Unit quaternions from three components and which one is missing."""
    rest = (levels.astype(np.float64) / most * 2.0 - 1.0) * _SQRT_HALF
    missing = np.sqrt(np.maximum(1.0 - (rest**2).sum(axis=1), 0.0))
    q = np.empty((len(largest), 4))
    np.put_along_axis(q, _OTHERS[largest], rest, axis=1)
    np.put_along_axis(q, largest[:, None], missing[:, None], axis=1)
    return q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
