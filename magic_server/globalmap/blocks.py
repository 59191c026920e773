"""Space cut into blocks, each refined by itself, so that a map may be larger than memory.

A k-d tree over what the keyframes look at cuts space into boxes until a box's keyframes are few
enough. Each Gaussian belongs to the one box that holds its mean. A box is refined with the
keyframes that look into it and with all Gaussians that these show, as agents sent them; only its
own are kept (the scheme of VastGaussian, Lin et al., CVPR 2024). No box waits for another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_server.globalmap.placement import PlacedSource

Point = NDArray[np.float64]

_SAMPLE_STEP = 24  # pixels between the samples that say what a keyframe looks at
_GUEST_SHARE = 0.2  # of a keyframe's samples inside a box, for it to teach the box too
_REACH_PERCENTILE = 2.0  # stray samples do not make a box's surroundings wide
_MARGIN_M = 0.3

ROUNDS = ((0.0, 0.6), (0.6, 0.8), (0.8, 1.0))
"""From where to where in the schedule of refinement each round of several blocks goes."""


@dataclass(frozen=True, slots=True)
class ViewPlace:
    """A keyframe and what it looks at."""

    source: int
    """Index of its sub-map."""
    keyframe: int
    seen: Point
    """(k, 3) world points on the surface it sees, metres; its own place where it has no depth."""

    @property
    def centre(self) -> Point:
        """(3,) the middle of what it sees."""
        return np.median(self.seen, axis=0)


@dataclass(frozen=True, slots=True)
class BlockView:
    """A keyframe that teaches a block."""

    source: int
    """Index of its sub-map."""
    keyframe: int


@dataclass(frozen=True, slots=True)
class Block:
    """A box of space, open towards the outside of the map, and the keyframes that teach it."""

    low: Point  # (3,) metres, inclusive
    high: Point  # (3,) metres, exclusive
    views: tuple[BlockView, ...]
    reach_low: Point
    """(3,) lowest corner of all that its keyframes show, metres."""
    reach_high: Point

    def holds(self, points: NDArray) -> NDArray[np.bool_]:
        """(n,) which points (n, 3) lie in the box."""
        return np.asarray(((points >= self.low) & (points < self.high)).all(axis=1))

    def wants(self, points: NDArray) -> NDArray[np.bool_]:
        """(n,) which points (n, 3) lie in the box or in what its keyframes show."""
        near = ((points >= self.reach_low) & (points <= self.reach_high)).all(axis=1)
        return self.holds(points) | near

    def touches(self, low: Point, high: Point) -> bool:
        """Whether it may want points of a box."""
        inside = (high >= self.low) & (low < self.high)
        near = (high >= self.reach_low) & (low <= self.reach_high)
        return bool(inside.all() or near.all())


def places_of(sources: Sequence[PlacedSource]) -> list[ViewPlace]:
    """What every keyframe looks at; reads one depth image at a time."""
    places = []
    for index, source in enumerate(sources):
        for keyframe, pose in enumerate(source.keyframe_poses()):
            world_from_camera = source.world_from_anchor @ pose
            _, depth = source.images(keyframe)
            half = _SAMPLE_STEP // 2
            points = source.camera.back_project(depth)[half::_SAMPLE_STEP, half::_SAMPLE_STEP]
            points = points[points[..., 2] > 0].reshape(-1, 3)
            if not len(points):
                points = np.zeros((1, 3), np.float32)
            places.append(
                ViewPlace(index, keyframe, se3.transform_points(world_from_camera, points))
            )
    return places


def plan_blocks(places: Sequence[ViewPlace], *, most_views: int) -> list[Block]:
    """Boxes that fill space without overlap, each with at most `most_views` keyframes of its own
    and half as many guests whose own box is another."""
    everywhere = (np.full(3, -np.inf), np.full(3, np.inf))
    boxes = _split(list(places), *everywhere, most_views=most_views)
    return [_with_guests(own, low, high, places, most=most_views // 2) for own, low, high in boxes]


def _split(
    places: list[ViewPlace], low: Point, high: Point, *, most_views: int
) -> list[tuple[list[ViewPlace], Point, Point]]:
    if len(places) <= most_views:
        return [(places, low, high)]
    centres = np.stack([place.centre for place in places])
    axis = int(np.ptp(centres, axis=0).argmax())
    order = np.argsort(centres[:, axis], kind="stable")
    middle = len(places) // 2
    cut = 0.5 * float(centres[order[middle - 1], axis] + centres[order[middle], axis])
    below, above = high.copy(), low.copy()
    below[axis], above[axis] = cut, cut
    first = [places[i] for i in order[:middle]]
    second = [places[i] for i in order[middle:]]
    return [
        *_split(first, low, below, most_views=most_views),
        *_split(second, above, high, most_views=most_views),
    ]


def _with_guests(
    own: list[ViewPlace], low: Point, high: Point, places: Sequence[ViewPlace], *, most: int
) -> Block:
    mine = {(place.source, place.keyframe) for place in own}
    shares = [
        (float(((place.seen >= low) & (place.seen < high)).all(axis=1).mean()), number)
        for number, place in enumerate(places)
        if (place.source, place.keyframe) not in mine
    ]
    best = sorted((pair for pair in shares if pair[0] >= _GUEST_SHARE), reverse=True)[:most]
    chosen = [*own, *(places[number] for _, number in best)]
    views = [BlockView(place.source, place.keyframe) for place in chosen]
    seen = np.concatenate([place.seen for place in chosen])
    reach = np.percentile(seen, (_REACH_PERCENTILE, 100 - _REACH_PERCENTILE), axis=0)
    return Block(
        low,
        high,
        tuple(sorted(views, key=lambda view: (view.source, view.keyframe))),
        reach[0] - _MARGIN_M,
        reach[1] + _MARGIN_M,
    )


def blocks_near(blocks: Sequence[Block], number: int) -> list[int]:
    """The other blocks that a block's keyframes may show."""
    block = blocks[number]
    others = (i for i in range(len(blocks)) if i != number)
    return [i for i in others if block.touches(blocks[i].low, blocks[i].high)]


def blocks_showing(blocks: Sequence[Block], number: int) -> list[int]:
    """The other blocks whose keyframes may show a block's Gaussians."""
    block = blocks[number]
    others = (i for i in range(len(blocks)) if i != number)
    return [i for i in others if blocks[i].touches(block.low, block.high)]
