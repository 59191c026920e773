"""Precision and recall of place detection and of loop verification, on recordings with poses.

Anchors are taken from every agent of every dataset; pairs across datasets never overlap. Ground
truth tells which pairs do, and what the right transform is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.data import FrameSource, open_dataset
from magic_core.errors import DataError
from magic_core.gaussians.seeding import seed_uniform
from magic_core.geometry import Camera, se3
from magic_core.submap import Descriptor
from magic_server.registration.config import RegistrationConfig
from magic_server.registration.register import RegistrationResult, register
from magic_server.registration.view import AnchorView, PreparedView, prepare

Array = NDArray[np.float64]
Describe = Callable[[NDArray[np.uint8]], Descriptor]

OVERLAP_BINS = ((0.3, 0.5), (0.5, 0.7), (0.7, 1.01))
LOOP_OVERLAP = 0.3
"""Pairs that overlap by this much are what detection should find."""
WANTED_RECALL = 0.95
"""What a calibrated threshold of similarity finds of these."""
STRIDE = 3
KEYFRAME_STEP = 10
"""Frames between the keyframes of an anchor."""
SEEDED_SHARE = 0.25
"""Gaussians per pixel of the method `means`."""
DEPTH_TOLERANCE_M = 0.08

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Anchor:
    """One view with its true pose."""

    dataset: str
    agent: str
    frame: int
    world_from_camera: Array
    view: AnchorView


@dataclass(frozen=True, slots=True)
class Criteria:
    """When a transform counts as right. Wide enough for the ground truth's own error."""

    max_error_m: float = 0.15
    max_error_rad: float = 0.07


def run(
    dataset: Path | str | Sequence[Path | str],
    *,
    methods: Sequence[tuple[str, ...]] = (
        ("visual", "kiss"),
        ("visual",),
        ("kiss",),
        ("fpfh",),
        ("means",),
    ),
    describers: Mapping[str, Describe] | None = None,
    every: int = 30,
    scale: float = 0.5,
    keyframes: int = 0,
    config: RegistrationConfig | None = None,
    criteria: Criteria | None = None,
    progress: Progress = lambda share, text: None,
) -> dict[str, Any]:
    """Register every pair of anchors with each set of methods, and compare with ground truth.

    `keyframes` are later images, KEYFRAME_STEP frames apart, that each anchor brings along.

    Returns `anchors`, `detection` per descriptor model, `verification` per set of methods
    (precision, recall by overlap, errors of what was accepted, seconds) and all `pairs`.
    """
    paths = [dataset] if isinstance(dataset, (str, Path)) else list(dataset)
    anchors = [
        anchor
        for path in paths
        for anchor in load_anchors(path, every=every, scale=scale, keyframes=keyframes)
    ]
    config, criteria = config or RegistrationConfig(), criteria or Criteria()
    index = [(i, j) for i in range(len(anchors)) for j in range(i)]
    overlaps = [true_overlap(anchors[i], anchors[j]) for i, j in index]
    views = [prepare(anchor.view, config) for anchor in anchors]
    rows: list[dict[str, Any]] = []
    verification = {}
    for names in methods:
        label = "+".join(names)
        chosen = replace(config, methods=tuple(names))  # type: ignore[arg-type]
        register(views[0], views[-1], chosen)  # loads libraries and kernels before the clock runs
        found = []
        for number, (i, j) in enumerate(index):
            progress(number / len(index), label)
            result = register(views[i], views[j], chosen)
            found.append(_row(label, anchors[i], anchors[j], overlaps[number], result))
        verification[label] = summary(found, criteria)
        rows += found
    return {
        "anchors": len(anchors),
        "pairs_overlapping": sum(overlap >= LOOP_OVERLAP for overlap in overlaps),
        "detection": {
            name: detection(anchors, index, overlaps, describe)
            for name, describe in (describers or {}).items()
        },
        "verification": verification,
        "pairs": rows,
    }


def load_anchors(
    dataset: Path | str, *, every: int, scale: float, keyframes: int = 0
) -> list[Anchor]:
    """Every n-th frame of each agent, with its true pose, and some frames that follow it."""
    found = []
    for source in open_dataset(dataset, scale=scale):
        for number in range(0, len(source), every):
            frame = source[number]
            means = _seeded_means(source.camera, frame.colour, frame.depth)
            view = AnchorView(
                source.camera,
                frame.colour,
                frame.depth,
                _following(source, number, keyframes),
                means=means,
            )
            name = str(Path(str(dataset)).name)
            found.append(Anchor(name, source.name, number, _true_pose(source, number), view))
    return found


def _following(
    source: FrameSource, anchor: int, count: int
) -> tuple[tuple[Array, NDArray[np.uint8], NDArray[np.float32]], ...]:
    """Frames after an anchor as a sub-map's keyframes, at their true poses."""
    anchor_from_world = se3.inverse(_true_pose(source, anchor))
    numbers = [anchor + KEYFRAME_STEP * (k + 1) for k in range(count)]
    return tuple(
        (anchor_from_world @ _true_pose(source, number), frame.colour, frame.depth)
        for number in numbers
        if number < len(source)
        for frame in (source[number],)
    )


def _true_pose(source: FrameSource, number: int) -> Array:
    pose = source[number].world_from_camera
    if pose is None:
        raise DataError(f"{source.name}: frame {number} has no ground truth pose")
    return pose


def _seeded_means(
    camera: Camera, colour: NDArray[np.uint8], depth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Where a sub-map that begins here seeds its Gaussians, by the paper's uniform sample."""
    count = max(1, int(SEEDED_SHARE * depth.size))
    seeds = seed_uniform(
        colour, depth, camera, need=depth > 0, count=count,
        existing=np.zeros((0, 3), np.float32), rng=np.random.default_rng(0),
    )  # fmt: skip
    return seeds.means


def true_overlap(source: Anchor, target: Anchor) -> float:
    """Share of readings that the other view confirms at the true poses, mean of both directions;
    0 across datasets."""
    if source.dataset != target.dataset:
        return 0.0
    target_from_source = se3.inverse(target.world_from_camera) @ source.world_from_camera
    forward = _confirmed(source.view, target.view, target_from_source)
    return 0.5 * (forward + _confirmed(target.view, source.view, se3.inverse(target_from_source)))


def summary(rows: Sequence[Mapping[str, Any]], criteria: Criteria) -> dict[str, Any]:
    """Precision, recall by overlap, errors and seconds of one set of methods."""
    accepted = [row for row in rows if row["accepted"]]
    right = [row for row in accepted if _is_right(row, criteria)]
    recall = {}
    for low, high in OVERLAP_BINS:
        inside = [row for row in rows if low <= row["true_overlap"] < high]
        hits = sum(row["accepted"] and _is_right(row, criteria) for row in inside)
        recall[f"{low:.1f}-{min(high, 1.0):.1f}"] = {
            "pairs": len(inside),
            "recall": hits / len(inside) if inside else None,
        }
    seconds = np.array([row["seconds"] for row in rows])
    return {
        "pairs": len(rows),
        "accepted": len(accepted),
        "wrong": len(accepted) - len(right),
        "precision": len(right) / len(accepted) if accepted else None,
        "recall_by_overlap": recall,
        "median_error_m": float(np.median([row["error_m"] for row in right])) if right else None,
        "median_error_rad": float(np.median([r["error_rad"] for r in right])) if right else None,
        "median_seconds": float(np.median(seconds)),
        "p95_seconds": float(np.percentile(seconds, 95)),
    }


def detection(
    anchors: Sequence[Anchor],
    index: Sequence[tuple[int, int]],
    overlaps: Sequence[float],
    describe: Describe,
) -> dict[str, Any]:
    """Precision and recall over thresholds of cosine similarity; a loop overlaps LOOP_OVERLAP."""
    vectors = np.stack([describe(anchor.view.colour).vector for anchor in anchors])
    similarity = np.array([float(vectors[i] @ vectors[j]) for i, j in index])
    is_loop = np.array(overlaps) >= LOOP_OVERLAP
    curve = []
    for threshold in np.arange(0.2, 0.96, 0.05):
        chosen = similarity >= threshold
        curve.append(
            {
                "threshold": round(float(threshold), 2),
                "precision": float(is_loop[chosen].mean()) if chosen.any() else None,
                "recall": float(chosen[is_loop].mean()) if is_loop.any() else None,
                "candidates": int(chosen.sum()),
            }
        )
    return {
        "curve": curve,
        "calibrated": calibrated(similarity, is_loop),
        "pairs": len(index),
        "loops": int(is_loop.sum()),
    }


def calibrated(
    similarity: NDArray[np.float64], is_loop: NDArray[np.bool_], *, recall: float = WANTED_RECALL
) -> dict[str, float] | None:
    """The largest threshold that finds `recall` of the loops; None where there are none.

    Registration refuses the wrong ones later, so that recall comes first.
    """
    loops = np.sort(similarity[is_loop])[::-1]
    if not len(loops):
        return None
    threshold = float(loops[int(np.ceil(recall * len(loops))) - 1])
    chosen = similarity >= threshold
    return {
        "threshold": threshold,
        "recall": float(chosen[is_loop].mean()),
        "precision": float(is_loop[chosen].mean()),
        "candidates": int(chosen.sum()),
    }


def _row(
    label: str, source: Anchor, target: Anchor, overlap: float, result: RegistrationResult
) -> dict[str, Any]:
    names = {
        f"{side}_{key}": value
        for side, anchor in (("source", source), ("target", target))
        for key, value in (
            ("dataset", anchor.dataset), ("agent", anchor.agent), ("frame", anchor.frame)
        )
    }  # fmt: skip
    row: dict[str, Any] = {"methods": label, **names, "true_overlap": overlap}
    figures = asdict(result)
    transform, information = figures.pop("target_from_source"), figures.pop("information")
    row |= figures
    row["least_information"] = float(np.linalg.eigvalsh(information)[0])
    row |= {"error_m": None, "error_rad": None, "error_squared_norm": None}
    if source.dataset == target.dataset:
        truth = se3.inverse(target.world_from_camera) @ source.world_from_camera
        error = se3.log(se3.orthonormalised(se3.inverse(truth) @ transform))
        row["error_m"] = float(np.linalg.norm((se3.inverse(truth) @ transform)[:3, 3]))
        row["error_rad"] = float(np.linalg.norm(error[3:]))
        row["error_squared_norm"] = float(error @ information @ error)
    return row


def _is_right(row: Mapping[str, Any], criteria: Criteria) -> bool:
    return (
        row["error_m"] is not None
        and row["error_m"] <= criteria.max_error_m
        and row["error_rad"] <= criteria.max_error_rad
    )


def _confirmed(moving: AnchorView, fixed: AnchorView, fixed_from_moving: Array) -> float:
    sampled = np.zeros_like(moving.depth)
    sampled[::STRIDE, ::STRIDE] = moving.depth[::STRIDE, ::STRIDE]
    points = moving.camera.back_project(sampled)[sampled > 0]
    if not len(points):
        return 0.0
    pixels, z = fixed.camera.project(se3.transform_points(fixed_from_moving, points))
    column = np.rint(pixels[:, 0]).astype(np.int64)
    row = np.rint(pixels[:, 1]).astype(np.int64)
    inside = (z > 0.1) & (column >= 0) & (row >= 0)
    inside &= (column < fixed.camera.width) & (row < fixed.camera.height)
    seen = fixed.depth[row[inside], column[inside]]
    close = np.abs(seen - z[inside]) < DEPTH_TOLERANCE_M * np.maximum(1.0, seen / 2.0)
    return float(((seen > 0) & close).sum() / len(points))


__all__ = ["Anchor", "Criteria", "PreparedView", "load_anchors", "run", "true_overlap"]
