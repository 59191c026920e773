"""Arrays that rows are added to, in constant time per row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.arrays import EdgeArrays

LEAST_CAPACITY = 64


class Rows:
    """A growing (n, ...) array."""

    def __init__(self, shape: tuple[int, ...], dtype: type = np.float64) -> None:
        self._buffer = np.zeros((LEAST_CAPACITY, *shape), dtype=dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def view(self) -> NDArray:
        """All rows, to read and to write; valid until the next one is added."""
        return self._buffer[: self._count]

    def append(self, row: NDArray | np.generic | float) -> int:
        """One more row; its number."""
        self._reserve(1)
        self._buffer[self._count] = row
        self._count += 1
        return self._count - 1

    def extend(self, rows: NDArray) -> None:
        """Several more rows."""
        self._reserve(len(rows))
        self._buffer[self._count : self._count + len(rows)] = rows
        self._count += len(rows)

    def _reserve(self, more: int) -> None:
        needed = self._count + more
        if needed > len(self._buffer):
            grown = np.zeros((max(needed, 2 * len(self._buffer)), *self._buffer.shape[1:]),
                             dtype=self._buffer.dtype)  # fmt: skip
            grown[: self._count] = self.view
            self._buffer = grown


class EdgeRows:
    """Edges that are added a few at a time and read by their numbers."""

    def __init__(self) -> None:
        self._source, self._target = Rows((), np.int64), Rows((), np.int64)
        self._matrices, self._information = Rows((4, 4)), Rows((6, 6))

    def __len__(self) -> int:
        return len(self._source)

    @property
    def source(self) -> NDArray[np.int64]:
        """(m,); valid until the next one is added."""
        return self._source.view

    @property
    def target(self) -> NDArray[np.int64]:
        """(m,); valid until the next one is added."""
        return self._target.view

    @property
    def every(self) -> EdgeArrays:
        """A copy of all of them."""
        return self.some(np.arange(len(self)))

    def add(self, edges: EdgeArrays) -> int:
        """More edges; the number of the last one."""
        self._source.extend(edges.source)
        self._target.extend(edges.target)
        self._matrices.extend(edges.source_from_target)
        self._information.extend(edges.information)
        return len(self) - 1

    def some(self, numbers: NDArray[np.int64] | list[int]) -> EdgeArrays:
        """Edges by their numbers."""
        index = np.asarray(numbers, dtype=np.int64)
        return EdgeArrays(
            self._source.view[index],
            self._target.view[index],
            self._matrices.view[index],
            self._information.view[index],
        )

    def ends(self, number: int) -> tuple[int, int]:
        """The vertices of one edge."""
        return int(self._source.view[number]), int(self._target.view[number])
