"""What descriptors of keyframes find that those of anchors do not, on recordings with poses.

A sub-map is an anchor and some frames behind it. Two of them share what any two of their images
share. The pairs that look alike by each number of described keyframes are registered and verified
as a server does it, those that look alike in front.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import se3
from magic_server.registration.benchmark import (
    LOOP_OVERLAP,
    OVERLAP_BINS,
    Anchor,
    Criteria,
    Describe,
    Progress,
    load_anchors,
    true_overlap,
)
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.register import register
from magic_server.registration.view import AnchorView, PreparedView, prepare

_P = ParamSpec("_P")
_T = TypeVar("_T")

Choose = Callable[[AnchorView, int], Sequence[int]]
"""At most so many of a view's keyframes to describe, by their place behind the anchor, from 1."""


@dataclass(frozen=True, slots=True)
class _Submap:
    anchor: Anchor
    images: tuple[Anchor, ...]
    """Of the anchor and every keyframe, each by itself."""
    vectors: NDArray[np.float32]  # (1 + keyframes, d)


@dataclass(frozen=True, slots=True)
class _Pair:
    source: int
    target: int
    overlap: float
    """Of the two images that share most."""
    truth: NDArray[np.float64] | None  # target_from_source (4, 4); None across datasets


class _Verifier:
    """Registers pairs, each way of leading images once."""

    def __init__(
        self, submaps: Sequence[_Submap], config: RegistrationConfig, criteria: Criteria
    ) -> None:
        self._submaps, self._config, self._criteria = submaps, config, criteria
        self._views: dict[tuple[int, int], PreparedView] = {}
        self._found: dict[tuple[int, int, int, int], tuple[bool, bool, float]] = {}

    def verify(self, pair: _Pair, leads: tuple[int, int]) -> tuple[bool, bool, float]:
        """(accepted, right, seconds) with these keyframes in front, 0 for the anchor."""
        key = (pair.source, pair.target, *leads)
        if key not in self._found:
            views = self._view(pair.source, leads[0]), self._view(pair.target, leads[1])
            result = register(*views, self._config)
            right = result.accepted and self._is_right(pair, result.target_from_source)
            self._found[key] = result.accepted, right, result.seconds
        return self._found[key]

    def _is_right(self, pair: _Pair, found: NDArray[np.float64]) -> bool:
        if pair.truth is None:
            return False
        miss = se3.log(se3.orthonormalised(se3.inverse(pair.truth) @ found))
        far = float(np.linalg.norm((se3.inverse(pair.truth) @ found)[:3, 3]))
        turned = float(np.linalg.norm(miss[3:]))
        return far <= self._criteria.max_error_m and turned <= self._criteria.max_error_rad

    def _view(self, submap: int, lead: int) -> PreparedView:
        if (submap, lead) not in self._views:
            view = self._submaps[submap].anchor.view
            order = sorted(range(len(view.keyframes)), key=lambda place: place + 1 != lead)
            keyframes = tuple(view.keyframes[place] for place in order)
            view = replace(view, keyframes=keyframes, lead=int(lead > 0))
            self._views[submap, lead] = prepare(view, self._config)
        return self._views[submap, lead]


def run(
    datasets: Sequence[Path | str],
    *,
    describe: Describe,
    choose: Choose,
    counts: Sequence[int],
    min_similarity: float,
    every: int = 50,
    scale: float = 0.5,
    keyframes: int = 4,
    config: RegistrationConfig | None = None,
    criteria: Criteria | None = None,
    progress: Progress = lambda share, text: None,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, Any]:
    """Detection and verification for each number of described keyframes.

    Returns `submaps`, `pairs`, `loops` (pairs that share LOOP_OVERLAP), `describe_ms` (median of
    the encoder for one image) and, in `described`, per number: descriptors per sub-map,
    `choose_ms` (median per sub-map), candidates, loops found and accepted by overlap, wrong ones,
    and the seconds that verification took.
    """
    describe_s: list[float] = []
    describe = _timed(describe, describe_s, clock)
    submaps = [
        _submap(anchor, describe)
        for path in datasets
        for anchor in load_anchors(path, every=every, scale=scale, keyframes=keyframes)
    ]
    pairs = [_pair(submaps, i, j) for i in range(len(submaps)) for j in range(i)]
    verifier = _Verifier(submaps, config or RegistrationConfig(), criteria or Criteria())
    rows = []
    for count in counts:
        choose_s: list[float] = []
        choose_now = _timed(choose, choose_s, clock)
        chosen = [[0, *choose_now(submap.anchor.view, count)] for submap in submaps]
        candidates = []
        for number, pair in enumerate(pairs):
            progress(number / len(pairs), f"{count} described keyframes")
            similarity, leads = _most_alike(submaps, chosen, pair)
            if similarity >= min_similarity:
                candidates.append((pair, *verifier.verify(pair, leads)))
        per_submap = float(np.mean([len(places) for places in chosen]))
        choose_ms = 1e3 * float(np.median(choose_s))
        rows.append(_row(count, per_submap, pairs, candidates) | {"choose_ms": choose_ms})
    return {
        "submaps": len(submaps),
        "pairs": len(pairs),
        "loops": sum(pair.overlap >= LOOP_OVERLAP for pair in pairs),
        "min_similarity": min_similarity,
        "describe_ms": 1e3 * float(np.median(describe_s)),
        "described": rows,
    }


def _timed(
    function: Callable[_P, _T], seconds: list[float], clock: Callable[[], float]
) -> Callable[_P, _T]:
    """The function; the seconds of each call are noted."""

    def timed(*arguments: _P.args, **named: _P.kwargs) -> _T:
        began = clock()
        result = function(*arguments, **named)
        seconds.append(clock() - began)
        return result

    return timed


def _submap(anchor: Anchor, describe: Describe) -> _Submap:
    view = anchor.view
    images = [(np.eye(4), view.colour, view.depth), *view.keyframes]
    single = tuple(
        replace(
            anchor,
            world_from_camera=anchor.world_from_camera @ pose,
            view=AnchorView(view.camera, colour, depth),
        )
        for pose, colour, depth in images
    )
    return _Submap(anchor, single, np.stack([describe(image[1]).vector for image in images]))


def _pair(submaps: Sequence[_Submap], source: int, target: int) -> _Pair:
    a, b = submaps[source], submaps[target]
    if a.anchor.dataset != b.anchor.dataset:
        return _Pair(source, target, 0.0, None)
    overlap = max(true_overlap(one, other) for one in a.images for other in b.images)
    truth = se3.inverse(b.anchor.world_from_camera) @ a.anchor.world_from_camera
    return _Pair(source, target, overlap, truth)


def _most_alike(
    submaps: Sequence[_Submap], chosen: Sequence[Sequence[int]], pair: _Pair
) -> tuple[float, tuple[int, int]]:
    """The largest similarity of the described images, and which they are."""
    ours, theirs = chosen[pair.source], chosen[pair.target]
    a, b = submaps[pair.source].vectors[ours], submaps[pair.target].vectors[theirs]
    similarity = a @ b.T
    i, j = np.unravel_index(similarity.argmax(), similarity.shape)
    return float(similarity[i, j]), (ours[int(i)], theirs[int(j)])


def _row(
    count: int,
    per_submap: float,
    pairs: Sequence[_Pair],
    candidates: Sequence[tuple[_Pair, bool, bool, float]],
) -> dict[str, Any]:
    by_overlap: dict[str, Mapping[str, int]] = {}
    for low, high in OVERLAP_BINS:
        inside = [found for found in candidates if low <= found[0].overlap < high]
        by_overlap[f"{low:.1f}-{min(high, 1.0):.1f}"] = {
            "pairs": sum(low <= pair.overlap < high for pair in pairs),
            "detected": len(inside),
            "right": sum(right for _, _, right, _ in inside),
        }
    accepted = sum(accepted for _, accepted, _, _ in candidates)
    right = sum(right for _, _, right, _ in candidates)
    return {
        "described": count,
        "descriptors_per_submap": per_submap,
        "candidates": len(candidates),
        "candidates_overlapping": sum(pair.overlap >= LOOP_OVERLAP for pair, *_ in candidates),
        "by_overlap": by_overlap,
        "accepted": accepted,
        "right": right,
        "wrong": accepted - right,
        "seconds": float(sum(seconds for *_, seconds in candidates)),
    }
