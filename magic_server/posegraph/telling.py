"""What was told of a growing graph, and what of it is news."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph.growing import Rows

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

NOTICEABLE_M = 1e-5
NOTICEABLE_RAD = 1e-6
"""A pose that moved by less is not news."""


@dataclass(frozen=True, slots=True)
class Change:
    """What a step changed."""

    vertices: Numbers
    """Numbers of those whose pose or component is not what was told before, ascending."""
    taken_up: Numbers
    """Numbers of the loops that now count."""
    dropped: Numbers
    """Numbers of the loops that no longer do."""
    largest_move_m: float
    """How far the farthest of them moved; new ones do not count."""

    def __bool__(self) -> bool:
        return bool(len(self.vertices) or len(self.taken_up) or len(self.dropped))


class Told:
    """Poses, components and loops as they were told last."""

    def __init__(self) -> None:
        self._poses, self._component = Rows((4, 4)), Rows((), np.int64)
        self._kept = Rows((), np.bool_)

    def add_vertex(self) -> None:
        """A vertex that nobody was told of."""
        self._poses.append(np.nan)
        self._component.append(-1)

    def add_loop(self) -> None:
        """A loop that nobody was told of."""
        self._kept.append(False)

    def know_vertex(self, number: int, pose: Array, component: int) -> None:
        """This was told of a vertex."""
        self._poses.view[number] = pose
        self._component.view[number] = component

    def know_loop(self, number: int) -> None:
        """It was told that a loop counts."""
        self._kept.view[number] = True

    @property
    def unknown(self) -> set[int]:
        """Vertices that nobody was told of."""
        return set(np.flatnonzero(np.isnan(self._poses.view[:, 0, 0])).tolist())

    def news(
        self, numbers: Numbers, poses: Array, component: Numbers, kept: Mask, *, scale: float
    ) -> Change:
        """Of some vertices, those that differ from what was told, which they are from now on.

        Poses are news once they moved by `scale` times the noticeable.
        """
        now, before = poses[numbers], self._poses.view[numbers]
        new = np.isnan(before[:, 0, 0])
        before = np.where(new[:, None, None], now, before)
        step_m = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
        # The small-angle form is exact enough to tell whether there is news.
        turn_rad = np.linalg.norm(now[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
        news = new | (step_m > scale * NOTICEABLE_M) | (turn_rad > scale * NOTICEABLE_RAD)
        news |= component[numbers] != self._component.view[numbers]
        flipped = kept != self._kept.view
        change = Change(
            vertices=numbers[news],
            taken_up=np.flatnonzero(flipped & kept),
            dropped=np.flatnonzero(flipped & ~kept),
            largest_move_m=float(step_m.max(initial=0.0)),
        )
        self._poses.view[change.vertices] = poses[change.vertices]
        self._component.view[change.vertices] = component[change.vertices]
        self._kept.view[flipped] = kept[flipped]
        return change
