"""Which frames become keyframes, and which keyframe an optimisation step looks at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_agent.mapping.config import KeyframeConfig
from magic_agent.mapping.coverage import Coverage
from magic_core.geometry import se3


def moved_enough(
    anchor_from_last: NDArray[np.float64],
    anchor_from_camera: NDArray[np.float64],
    *,
    median_depth: float,
    config: KeyframeConfig,
) -> bool:
    """Whether the camera moved or turned past the thresholds since the last keyframe."""
    last_from_camera = se3.inverse(anchor_from_last) @ anchor_from_camera
    shift = float(np.linalg.norm(last_from_camera[:3, 3]))
    turn = float(np.rad2deg(se3.rotation_angle(last_from_camera)))
    return shift > config.translation * median_depth or turn > config.rotation_deg


class Window:
    """Chooses keyframes for optimisation: the newest often, the others by loss, coverage, neglect.

    A keyframe that fits badly, shows surface that few steps have looked at, or was not looked at
    for long, is likelier. So every part of the sub-map keeps its share however long the sub-map is
    and however often the camera came by, and well fitted views cost little.
    """

    def __init__(self, newest_share: float, rng: np.random.Generator) -> None:
        self._newest_share = newest_share
        self._rng = rng
        self._losses: list[float] = []
        self._waits: list[float] = []
        self._coverage = Coverage()

    def __len__(self) -> int:
        return len(self._losses)

    def add(self, points: NDArray[np.floating], *, depth_m: float) -> None:
        """Take in a new keyframe, the newest from now on: its surface (n, 3) in the anchor frame
        and its median depth."""
        self._losses.append(max(self._losses, default=1.0))
        self._waits.append(1.0)
        self._coverage.add(points, depth_m=depth_m)

    def make_room(self, most: int) -> int | None:
        """Forget the keyframe that the others cover best when there are more than `most`; returns
        its index. The first, the anchor, and the newest stay."""
        if len(self._losses) <= most:
            return None
        index = self._coverage.most_redundant(range(1, len(self._losses) - 1))
        del self._losses[index], self._waits[index]
        self._coverage.remove(index)
        return index

    def choose(self) -> int:
        """Index of the keyframe for the next step."""
        newest = len(self._losses) - 1
        if newest == 0 or self._rng.random() < self._newest_share:
            return newest
        return self.choose_any()

    def choose_any(self) -> int:
        """The same without preference for the newest: for the steps that close a sub-map."""
        neglect = [self._coverage.neglect(index) for index in range(len(self._losses))]
        weights = np.array(self._losses) * np.array(self._waits) * np.array(neglect)
        return int(self._rng.choice(len(weights), p=weights / weights.sum()))

    def report(self, index: int, loss: float) -> None:
        """Note the loss that a step found on a keyframe."""
        self._waits = [wait + 1.0 for wait in self._waits]
        self._losses[index] = max(loss, 1e-6)
        self._waits[index] = 1.0
        self._coverage.look(index)
