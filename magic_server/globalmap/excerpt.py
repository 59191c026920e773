"""A part of a map: what lies in a region, in less detail where that is too much.

The map is a file that may be larger than memory, and so is what is made of it: Gaussians pass
through memory a piece at a time.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.gaussians.columns import PIECE, ColumnFile
from magic_core.gaussians.reduction import reduced
from magic_core.gaussians.region import Region

_MOST_REDUCTION = 8
"""A piece becomes smaller by this at most before it is joined with its neighbours."""


@dataclass(frozen=True, slots=True)
class Excerpt:
    """A part of a map, to be read in pieces."""

    columns: ColumnFile
    full_count: int
    """Gaussians that the map has in the region."""

    def pieces(self) -> Iterator[GaussianCloud]:
        """Its Gaussians, which are in the map's order where none were merged."""
        return self.columns.pieces()


def excerpt_of(
    source: ColumnFile, folder: Path, *, region: Region | None, max_gaussians: int
) -> Excerpt:
    """The part of a map that lies in a region, at most `max_gaussians` (0: all); uses a folder.

    Merged Gaussians stay in the region: each is between those that it is made of.
    """
    names = (folder / f"columns-{number}" for number in itertools.count())
    columns = source if region is None else _inside(source, next(names), region)
    full = len(columns)
    while 0 < max_gaussians < len(columns):
        columns = _coarser(columns, next(names), max_gaussians)
    return Excerpt(columns, full)


def _inside(source: ColumnFile, path: Path, region: Region) -> ColumnFile:
    starts = range(0, len(source), PIECE)
    inside = [
        start + np.flatnonzero(region.holds(source.means[start : start + PIECE]))
        for start in starts
    ]
    chosen = ColumnFile(path, sum(len(places) for places in inside))
    return _filled(chosen, (source.cloud(places) for places in inside))


def _coarser(source: ColumnFile, path: Path, count: int) -> ColumnFile:
    """`count` Gaussians, or more where that takes another turn: a piece that becomes very small
    has lost its neighbours in other pieces."""
    order = source.in_morton_order()
    pieces = np.array_split(order, -(-len(order) // PIECE))
    if len(pieces) > 1:
        count = max(count, len(order) // _MOST_REDUCTION)
    ends = np.cumsum([0, *map(len, pieces)]) * count // len(order)
    sizes = np.diff(ends).tolist()
    return _filled(ColumnFile(path, sum(sizes)), _reduced(source, pieces, sizes))


def _reduced(
    source: ColumnFile, pieces: list[NDArray[np.int64]], sizes: list[int]
) -> Iterator[GaussianCloud]:
    for places, size in zip(pieces, sizes, strict=True):
        yield reduced(source.cloud(places), size)


def _filled(columns: ColumnFile, clouds: Iterator[GaussianCloud]) -> ColumnFile:
    start = 0
    for cloud in clouds:
        columns.put(start, cloud)
        start += len(cloud)
    return columns
