"""Space cut into blocks, each refined by itself, so that a map may be larger than memory.

A k-d tree over what the keyframes look at cuts space into boxes until a box's keyframes are few
enough. Each Gaussian belongs to the one box that holds its mean. A box is refined with the part of
each keyframe that looks into it, and with all Gaussians that these parts show, as agents sent them;
only its own are kept (the scheme of VastGaussian, Lin et al., CVPR 2024). No box waits for another.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera, se3
from magic_server.globalmap.placement import PlacedSource, Window

Point = NDArray[np.float64]

_SAMPLES_ACROSS = 16  # an image: points that say what a keyframe looks at
_GUEST_SHARE = 0.02  # of a keyframe's samples inside a box, for it to teach the box too
_WIDER = 3  # samples by which a part is wider on all sides than what lies in the box
_WHOLE = 0.8  # of an image: parts larger than this are taken as all of it
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
    pixels: NDArray[np.int64]
    """(k, 2) where it sees them: column and row."""
    size: tuple[int, int]
    """Width and height of its images."""

    @property
    def centre(self) -> Point:
        """(3,) the middle of what it sees."""
        return np.median(self.seen, axis=0)

    @property
    def step(self) -> int:
        """Pixels between samples."""
        return _sample_step(*self.size)


@dataclass(frozen=True, slots=True)
class BlockView:
    """The part of a keyframe that teaches a block."""

    source: int
    """Index of its sub-map."""
    keyframe: int
    window: Window | None = None
    """Which part; None is all of it."""


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
        return _inside(points, self.low, self.high)

    def wants(self, points: NDArray) -> NDArray[np.bool_]:
        """(n,) which points (n, 3) lie in the box or in what its keyframes show."""
        near = ((points >= self.reach_low) & (points <= self.reach_high)).all(axis=1)
        return self.holds(points) | near

    def touches(self, low: Point, high: Point) -> bool:
        """Whether it may want points of a box."""
        return bool(_touching(self, low, high))


def _touching(block: Block, low: Point, high: Point) -> NDArray[np.bool_]:
    """(n,) whether a block may want points of each box (n, 3)."""
    inside = (high >= block.low) & (low < block.high)
    near = (high >= block.reach_low) & (low <= block.reach_high)
    return np.asarray(inside.all(axis=-1) | near.all(axis=-1))


def places_of(sources: Sequence[PlacedSource]) -> list[ViewPlace]:
    """What every keyframe looks at; reads one depth image at a time."""
    places = []
    for index, source in enumerate(sources):
        size = (source.camera.width, source.camera.height)
        for keyframe, pose in enumerate(source.keyframe_poses()):
            world_from_camera = source.world_from_anchor @ pose
            pixels, points = _samples(source.camera, source.images(keyframe)[1])
            seen = se3.transform_points(world_from_camera, points)
            places.append(ViewPlace(index, keyframe, seen, pixels, size))
    return places


def _samples(camera: Camera, depth: NDArray) -> tuple[NDArray[np.int64], NDArray]:
    """Pixels (k, 2) spread over an image and the points (k, 3) seen there, in the camera frame.
    Where depth is unknown it is that of the nearest sample with depth."""
    from scipy.spatial import KDTree

    pixels = _sampled(camera.width, camera.height)
    measured = depth[pixels[:, 1], pixels[:, 0]]
    known = measured > 0
    if not known.any():
        return pixels, np.zeros((len(pixels), 3), np.float32)
    _, nearest = KDTree(pixels[known]).query(pixels)
    metres = np.where(known, measured, measured[known][nearest])
    return pixels, camera.rays()[pixels[:, 1], pixels[:, 0]] * metres[:, None]


@functools.lru_cache(maxsize=16)
def _sampled(width: int, height: int) -> NDArray[np.int64]:
    """Pixels spread over an image; the same array for all keyframes of a size."""
    step = _sample_step(width, height)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _sample_step(width: int, height: int) -> int:
    return max(min(width // _SAMPLES_ACROSS, height), 1)


def plan_blocks(places: Sequence[ViewPlace], *, most_views: int) -> list[Block]:
    """Boxes that fill space without overlap, each with at most `most_views` keyframes of its own,
    and parts of others that add up to at most one and a half times as many images."""
    everywhere = (np.full(3, -np.inf), np.full(3, np.inf))
    centres = np.stack([place.centre for place in places])
    boxes = _split(centres, np.arange(len(places)), *everywhere, most_views=most_views)
    lowest = np.stack([place.seen.min(axis=0) for place in places])
    highest = np.stack([place.seen.max(axis=0) for place in places])
    blocks = []
    for own, low, high in boxes:
        # Most keyframes look nowhere near, and their samples need not be gone through.
        near = np.asarray(((highest >= low) & (lowest < high)).all(axis=1))
        near[own] = True
        blocks.append(
            _with_guests(
                own, low, high, places, np.flatnonzero(near), most=most_views + most_views // 2
            )
        )
    return blocks


def _split(
    centres: Point, numbers: NDArray[np.intp], low: Point, high: Point, *, most_views: int
) -> list[tuple[NDArray[np.intp], Point, Point]]:
    """Boxes, each with the numbers of its keyframes."""
    if len(numbers) <= most_views:
        return [(numbers, low, high)]
    chosen = centres[numbers]
    axis = int(np.ptp(chosen, axis=0).argmax())
    order = np.argsort(chosen[:, axis], kind="stable")
    middle = len(numbers) // 2
    cut = 0.5 * float(chosen[order[middle - 1], axis] + chosen[order[middle], axis])
    below, above = high.copy(), low.copy()
    below[axis], above[axis] = cut, cut
    return [
        *_split(centres, numbers[order[:middle]], low, below, most_views=most_views),
        *_split(centres, numbers[order[middle:]], above, high, most_views=most_views),
    ]


def _with_guests(
    own: NDArray[np.intp],
    low: Point,
    high: Point,
    places: Sequence[ViewPlace],
    near: NDArray[np.intp],
    *,
    most: int,
) -> Block:
    """A box with its keyframes, and those of the ones `near` that look into it."""
    mine = set(own.tolist())
    inside = {number: _inside(places[number].seen, low, high) for number in near.tolist()}
    shares = {number: float(chosen.mean()) for number, chosen in inside.items()}
    views, seen, room = [], [], float(most)
    for number in sorted(inside, key=lambda number: -shares[number]):
        place, is_mine = places[number], number in mine
        if not is_mine and (shares[number] < _GUEST_SHARE or room <= 0.0):
            continue
        window = _window(place, inside[number])
        shown = _within(place, window)
        room -= 0.0 if is_mine else float(shown.mean())
        views.append(BlockView(place.source, place.keyframe, window))
        seen.append(place.seen[shown])
    reach = np.percentile(
        np.concatenate(seen), (_REACH_PERCENTILE, 100 - _REACH_PERCENTILE), axis=0
    )
    return Block(
        low,
        high,
        tuple(sorted(views, key=lambda view: (view.source, view.keyframe))),
        reach[0] - _MARGIN_M,
        reach[1] + _MARGIN_M,
    )


def _window(place: ViewPlace, inside: NDArray[np.bool_]) -> Window | None:
    """The part of an image that shows a box, and some of what is beside it."""
    if not inside.any():
        return None
    (width, height), chosen, wider = place.size, place.pixels[inside], _WIDER * place.step
    left, top = np.maximum(chosen.min(axis=0) - wider, 0).tolist()
    right, bottom = np.minimum(chosen.max(axis=0) + wider + 1, place.size).tolist()
    whole = (right - left) * (bottom - top) >= _WHOLE * width * height
    return None if whole else (left, top, right, bottom)


def _within(place: ViewPlace, window: Window | None) -> NDArray[np.bool_]:
    """(k,) which samples of a keyframe lie in a window of it."""
    if window is None:
        return np.ones(len(place.seen), dtype=bool)
    return _inside(place.pixels, np.array(window[:2]), np.array(window[2:]))


def _inside(points: NDArray, low: NDArray, high: NDArray) -> NDArray[np.bool_]:
    """(n,) which points (n, d) are at least `low` and less than `high` along every axis."""
    return np.asarray(((points >= low) & (points < high)).all(axis=1))


class Neighbours:
    """Which blocks' keyframes may show which others; found for all at once, as there are many."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        low, high = (np.stack([getattr(b, name) for b in blocks]) for name in ("low", "high"))
        self._shows = np.stack([_touching(block, low, high) for block in blocks])
        np.fill_diagonal(self._shows, False)

    def near(self, number: int) -> list[int]:
        """The other blocks that a block's keyframes may show."""
        return np.flatnonzero(self._shows[number]).tolist()

    def showing(self, numbers: Sequence[int]) -> list[int]:
        """The blocks whose keyframes may show the Gaussians of any of these that are others'."""
        return np.flatnonzero(self._shows[:, list(numbers)].any(axis=1)).tolist()
