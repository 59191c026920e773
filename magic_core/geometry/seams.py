"""What corrections move, spread over a sub-map's frames instead of left as steps at its ends.

The pose graph moves a sub-map as a whole. Where it changes how two successive sub-maps of an agent
lie to each other, a step is left between the last frame of one and the first of the next, though
the tracking error that it corrects grew over all the frames between. So a seam's disagreement is
shared: each side takes half of it at the seam and less the further a frame is away, none from the
middle of the sub-map on. Both sides then meet at the seam. Frames only are moved, when they are
read: what is stored, the Gaussians and the anchors stay as they are.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.geometry import se3

Pose = NDArray[np.float64]
Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Seams:
    """Where a sub-map meets those before and behind it, and how far they disagree there."""

    start: NDArray[np.float64] | None = None
    """(6,) Moves the anchor to where the sub-map before says that it is: log(anchor_from_expected),
    tangent order (translation, rotation); None where there is no sub-map before."""
    end: tuple[Pose, NDArray[np.float64]] | None = None
    """Where this sub-map expects the next anchor, anchor_from_next (4, 4), and what moves that to
    where it is, (6,) log(expected_from_next); None where there is no sub-map behind."""

    @classmethod
    def of(
        cls,
        world_from_anchor: ArrayLike,
        *,
        before: tuple[Pose, Pose] | None = None,
        behind: tuple[Pose, Pose] | None = None,
    ) -> Seams:
        """From corrected anchors (4, 4).

        `before` is the world_from_anchor of the sub-map before and this one's odometry,
        previous_from_anchor; `behind` is the world_from_anchor of the next one and its odometry.
        """
        anchor = np.asarray(world_from_anchor, np.float64)
        start, end = None, None
        if before is not None:
            start = se3.log(se3.inverse(anchor) @ before[0] @ before[1])
        if behind is not None:
            end = behind[1], se3.log(se3.inverse(anchor @ behind[1]) @ behind[0])
        return cls(start, end)

    def spread(
        self, anchor_from_cameras: ArrayLike, shares: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        """Move frames (n, 4, 4), each at its share of the sub-map: 0 at its anchor, 1 at the next.

        Without `shares` they are all its frames in order, which lie evenly between the anchors.
        Raises ValueError where there is not one share for each frame.
        """
        frames = np.array(anchor_from_cameras, np.float64).reshape(-1, 4, 4)
        share = np.asarray(even_shares(len(frames)) if shares is None else shares, np.float64)
        if share.shape != frames.shape[:1]:
            raise ValueError(f"{len(frames)} frames, but shares of shape {share.shape}")
        if self.start is not None:
            early = share < 0.5
            frames[early] = se3.fractions(self.start, 0.5 - share[early]) @ frames[early]
        if self.end is not None:
            seam, twist = self.end
            late = share > 0.5
            moved = seam @ se3.fractions(twist, share[late] - 0.5) @ se3.inverse(seam)
            frames[late] = moved @ frames[late]
        return frames


def even_shares(count: int) -> NDArray[np.float64]:
    """(count,) how far along its sub-map each frame is: 0 at the anchor, 1 at the next one."""
    return np.arange(count) / max(count, 1)


NO_SEAMS = Seams()
"""A sub-map by itself: its frames stay where they are."""


def seams_between(
    anchors: Mapping[Name, Pose], odometry: Mapping[Name, tuple[Name, Pose]]
) -> dict[Name, Seams]:
    """The seams of every sub-map from its world_from_anchor (4, 4), all of one solution.

    `odometry` tells the sub-map before and previous_from_anchor (4, 4). Where that one has no
    place, there is no seam.
    """
    before = {name: edge for name, edge in odometry.items() if edge[0] in anchors}
    behind = {previous: (name, motion) for name, (previous, motion) in before.items()}

    def neighbour(edge: tuple[Name, Pose] | None) -> tuple[Pose, Pose] | None:
        return None if edge is None else (anchors[edge[0]], edge[1])

    return {
        name: Seams.of(
            anchor, before=neighbour(before.get(name)), behind=neighbour(behind.get(name))
        )
        for name, anchor in anchors.items()
    }
