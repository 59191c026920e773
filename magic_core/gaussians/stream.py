"""Map files written from pieces, so that a map may be larger than memory.

The bytes are those of `ply` and `codec`; pieces come from a function that can be called again,
because a layout of columns is written in several places at once.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from magic_core.gaussians import codec, compact, ply
from magic_core.gaussians.cloud import GaussianCloud

Pieces = Callable[[], Iterator[GaussianCloud]]
_COPY_BYTES = 1 << 20


def write_ply_pieces(path: Path, pieces: Pieces) -> int:
    """Write a 3DGS PLY of all pieces in order; returns the number of Gaussians."""
    count = sum(len(piece) for piece in pieces())
    with path.open("wb") as file:
        file.write(ply.header(count))
        for piece in pieces():
            file.write(ply.rows(piece).tobytes())
    return count


def write_lossless_pieces(path: Path, pieces: Pieces) -> None:
    """Write the lossless layout of all pieces in order."""
    count = sum(len(piece) for piece in pieces())
    with tempfile.TemporaryFile(dir=path.parent) as columns:
        start = 0
        for piece in pieces():
            offset = 0
            for array, width in zip(piece.arrays(), codec.LOSSLESS_COLUMNS, strict=True):
                _put(columns, offset + 4 * width * start, array.astype("<f4"))
                offset += 4 * width * count
            start += len(piece)
        size = codec.LOSSLESS_BYTES * count
        _compress(path, columns, codec.LOSSLESS, count=count, size=size, level=3)


@dataclass(slots=True)
class _Extent:
    """Ranges over all pieces, which every code depends on."""

    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    log_scale: tuple[float, float]
    colour: tuple[float, float]


def write_compact_pieces(
    path: Path, pieces: Pieces, options: codec.CompactOptions = codec.DEFAULT_COMPACT
) -> None:
    """Write the compact layout of all pieces in order, each sorted by Morton code in itself."""
    extent = _extent(pieces)
    span = float((extent.high - extent.low).max()) if extent.count else 0.0
    grid = compact.Grid(extent.low, max(options.position_step_m, span / compact.MAX_GRID))
    n, start = extent.count, 0
    last = compact.Last()
    with tempfile.TemporaryFile(dir=path.parent) as columns:
        _put(columns, 0, compact.pack_ranges(grid, extent.log_scale, extent.colour))
        for piece in pieces():
            codes = compact.codes_of(piece, grid, extent.log_scale, extent.colour, after=last)
            for number, column in enumerate(codes.columns):
                _put(columns, codec.RANGES_BYTES + number * n + start, column)
            last = codes.last
            start += len(piece)
        size = codec.RANGES_BYTES + codec.COMPACT_BYTES * n
        _compress(path, columns, codec.COMPACT, count=n, size=size, level=options.zstd_level)


def _extent(pieces: Pieces) -> _Extent:
    count, lows, highs, scales, colours = 0, [], [], [], []
    for piece in pieces():
        if len(piece):
            count += len(piece)
            means = piece.means.astype(np.float64)
            lows.append(means.min(axis=0))
            highs.append(means.max(axis=0))
            scales.append((piece.scales.min(), piece.scales.max()))
            colours.append((piece.colours.min(), piece.colours.max()))
    if not count:
        return _Extent(0, np.zeros(3), np.zeros(3), (0.0, 0.0), (0.0, 1.0))
    logs = np.log(np.maximum(np.array(scales, np.float64), 1e-12))
    tones = np.array(colours, np.float64)
    low, high = (float(np.float32(value)) for value in (logs.min(), logs.max()))
    darkest = float(np.float32(min(0.0, tones.min())))
    return _Extent(
        count, np.min(lows, axis=0), np.max(highs, axis=0), (low, high),
        (darkest, float(np.float32(max(1.0, tones.max())))),
    )  # fmt: skip


def _put(file: BinaryIO, offset: int, data: NDArray | bytes) -> None:
    file.seek(offset)
    file.write(data if isinstance(data, bytes) else np.ascontiguousarray(data).tobytes())


def _compress(
    path: Path, columns: BinaryIO, layout: int, *, count: int, size: int, level: int
) -> None:
    columns.flush()
    columns.truncate(size)
    columns.seek(0)
    compressor = zstandard.ZstdCompressor(level=level)
    with path.open("wb") as file:
        file.write(codec.header(layout, count))
        compressor.copy_stream(columns, file, size=size, read_size=_COPY_BYTES)
        file.flush()
        os.fsync(file.fileno())
