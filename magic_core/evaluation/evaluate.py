"""A run's accuracy: the part of `magic run --json` that needs the data and the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from magic_core.data import FrameSource
from magic_core.evaluation.accuracy import ground_truth_of, measure_trajectories
from magic_core.evaluation.run_folder import RunFolder
from magic_core.evaluation.views import (
    VIEW_KINDS,
    ComparedView,
    Renders,
    choose_views,
    compare_views,
)
from magic_core.gaussians import GaussianCloud


def evaluate_run(
    run: RunFolder,
    *,
    sources: Sequence[FrameSource],
    cloud: GaussianCloud | None = None,
    views_per_kind: int = 48,
    rasteriser: Renders | None = None,
) -> dict[str, Any]:
    """Measure trajectories and the merged map of a run.

    Args:
        run: its trajectories and agent reports are read; ground truth that the sources have and
            the folder lacks is written into it.
        sources: the data the run was made from, opened with the same scale and frames.
        cloud: the merged map in the frame of the largest component; default: map.ply.
        views_per_kind: most views rendered of each kind, spread evenly over agents and time.
        rasteriser: default: the CPU rasteriser.

    Returns `ate_rmse_m` and `ate_tracked_rmse_m` {agent: metres} (the former with "joint": one
    alignment for all agents of the largest component; null where there is no ground truth),
    `psnr_db`, `ssim`, `depth_l1_m` {"train", "novel"} (train = keyframes, novel = frames never
    used for mapping; null without a map), `views` (how many of each were rendered) and
    `components` (how many there are).
    """
    _write_missing_ground_truth(run, sources)
    accuracy = measure_trajectories(run)
    compared = _compared(run, sources, cloud, views_per_kind, rasteriser)
    result: dict[str, Any] = {
        "ate_rmse_m": {**accuracy.corrected_m, "joint": accuracy.joint_m},
        "ate_tracked_rmse_m": accuracy.tracked_m,
    }
    for name in ("psnr_db", "ssim", "depth_l1_m"):
        result[name] = {kind: _mean(compared, kind, name) for kind in VIEW_KINDS}
    result["views"] = {
        kind: sum(view.chosen.kind == kind for view in compared) for kind in VIEW_KINDS
    }
    if run.components_path.is_file():
        result["components"] = len(run.read_components().members)
    return result


def _write_missing_ground_truth(run: RunFolder, sources: Sequence[FrameSource]) -> None:
    for source in sources:
        if not run.has_trajectory(source.name, "ground_truth"):
            truth = ground_truth_of(source)
            if truth is not None:
                run.write_trajectory(source.name, "ground_truth", truth)


def _compared(
    run: RunFolder,
    sources: Sequence[FrameSource],
    cloud: GaussianCloud | None,
    views_per_kind: int,
    rasteriser: Renders | None,
) -> list[ComparedView]:
    if cloud is None:
        if not run.map_path.is_file():
            return []
        cloud = run.read_map()
    views = choose_views(run, sources, per_kind=views_per_kind)
    return list(compare_views(views, cloud, rasteriser or default_rasteriser()))


def default_rasteriser() -> Renders:
    """The CPU rasteriser, imported when first needed."""
    from magic_core.render import Rasteriser

    return Rasteriser()


def _mean(views: Sequence[ComparedView], kind: str, attribute: str) -> float | None:
    values = [getattr(view, attribute) for view in views if view.chosen.kind == kind]
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
