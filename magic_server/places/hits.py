"""What goes into an index of places, and what comes out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from numpy.typing import ArrayLike


class Place(NamedTuple):
    """A sub-map as it is looked for."""

    name: str
    """Its resource name."""
    vector: ArrayLike  # (d,) the anchor's descriptor
    keyframes: Sequence[tuple[int, ArrayLike]] = ()
    """Further views by which it is found: place among its keyframes, above 0, and descriptor."""


class Hit(NamedTuple):
    """A sub-map that looks like what was asked for."""

    name: str
    similarity: float
    """Cosine of the two descriptors that are most alike."""
    keyframe: int = 0
    """Which of its views that is: place among its keyframes; 0 is the anchor."""
    query: int = 0
    """Which of the vectors that were asked for."""


def best_of_each(hits: Iterable[Hit], count: int) -> list[Hit]:
    """The best hit of each sub-map, at most `count`; of equals the first, as they were ordered."""
    best: dict[str, Hit] = {}
    for hit in sorted(hits, key=lambda hit: -hit.similarity):
        best.setdefault(hit.name, hit)
    return list(best.values())[:count]
