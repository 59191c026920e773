"""Gaussians in a file of plain columns: any of them is read without the others in memory.

The columns are those of the codec's lossless layout, before compression.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from magic_core.errors import CorruptData
from magic_core.gaussians import codec
from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.morton import BITS, morton_codes

PIECE = 1 << 18
"""Gaussians that are in memory at a time: 15 MB."""


class ColumnFile:
    """n Gaussians in a file."""

    def __init__(self, path: Path, count: int) -> None:
        """A file that is there, or a new one whose Gaussians are to be `put`."""
        with path.open("ab") as file:
            file.truncate(codec.LOSSLESS_BYTES * count)
        self._path, self._count = path, count
        self._columns: list[NDArray[np.float32]] = []
        for width, offset in self._layout():
            shape = (count,) if width == 1 else (count, width)
            self._columns.append(
                np.memmap(path, "<f4", "r", offset, shape) if count else np.empty(shape, "<f4")
            )

    @classmethod
    def unpacked(cls, path: Path, pieces: Iterable[bytes]) -> ColumnFile:
        """A blob of the lossless layout, given in pieces, as a new file.

        CorruptData where it is none.
        """
        ahead = b""
        incoming = iter(pieces)
        while len(ahead) < codec.HEADER_BYTES and (piece := next(incoming, None)) is not None:
            ahead += piece
        count = codec.gaussian_count(ahead)
        try:
            with path.open("wb") as file:
                with zstandard.ZstdDecompressor().stream_writer(file, closefd=False) as frame:
                    frame.write(ahead[codec.HEADER_BYTES :])
                    for piece in incoming:
                        frame.write(piece)
                length = file.tell()
        except zstandard.ZstdError as error:
            raise CorruptData(f"Gaussian payload is not a zstd frame: {error}") from error
        if length != codec.LOSSLESS_BYTES * count:
            raise CorruptData(
                f"Gaussian payload of {length} bytes; {count} in the lossless layout take "
                f"{codec.LOSSLESS_BYTES * count}"
            )
        return cls(path, count)

    def __len__(self) -> int:
        return self._count

    @property
    def means(self) -> NDArray[np.float32]:
        """(n, 3), in the file."""
        return self._columns[0]

    def cloud(self, index: NDArray | slice) -> GaussianCloud:
        """Some of them, in memory."""
        return GaussianCloud(
            *(np.ascontiguousarray(column[index], np.float32) for column in self._columns)
        )

    def put(self, start: int, cloud: GaussianCloud) -> None:
        """Write Gaussians from place `start` on."""
        # Not through the mapping: there a full disk ends the process, here it is an OSError.
        with self._path.open("r+b") as file:
            for (width, offset), values in zip(self._layout(), cloud.arrays(), strict=True):
                file.seek(offset + 4 * width * start)
                file.write(values.astype("<f4").tobytes())

    def _layout(self) -> Iterator[tuple[int, int]]:
        """Numbers in a row of each column, and where in the file the column begins."""
        offset = 0
        for width in codec.LOSSLESS_COLUMNS:
            yield width, offset
            offset += 4 * width * self._count

    def pieces(self) -> Iterator[GaussianCloud]:
        """All of them in order."""
        for start in range(0, self._count, PIECE):
            yield self.cloud(slice(start, start + PIECE))

    def in_morton_order(self) -> NDArray[np.int64]:
        """(n,) places of all, neighbours in space near each other; 16 bytes of memory each."""
        starts = range(0, self._count, PIECE)
        low = np.min([self.means[i : i + PIECE].min(axis=0) for i in starts], axis=0)
        high = np.max([self.means[i : i + PIECE].max(axis=0) for i in starts], axis=0)
        span = max(float((high.astype(np.float64) - low).max()), 1e-12)
        codes = np.empty(self._count, np.uint64)
        for i in starts:
            unit = (self.means[i : i + PIECE].astype(np.float64) - low) / span
            codes[i : i + PIECE] = morton_codes(np.rint(unit * (2**BITS - 1)).astype(np.int64))
        return np.argsort(codes, kind="stable")
