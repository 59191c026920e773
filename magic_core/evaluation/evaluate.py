"""A run's accuracy: the part of `magic run --json` that needs the data and the map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magic_core.data import FrameSource
from magic_core.evaluation.accuracy import ground_truth_of, measure_trajectories
from magic_core.evaluation.run_folder import RunFolder
from magic_core.evaluation.views import (
    VIEW_KINDS,
    ChosenView,
    Perceptual,
    Renders,
    choose_views,
    compare_views,
)
from magic_core.gaussians import GaussianCloud

IMAGE_METRICS = ("psnr_db", "ssim", "ms_ssim", "lpips", "depth_l1_m")
VIEW_CLASSES = (*VIEW_KINDS, *(f"{kind}_coarse" for kind in VIEW_KINDS))
NO_WEIGHTS = (
    "no LPIPS weights found; give --lpips-weights FILE, or set MAGIC_LPIPS_WEIGHTS to "
    "lpips_alexnet_fp16.safetensors"
)
NO_COARSE_MAP = "the run folder holds no map_coarse.ply: it was made before such maps were kept"


@dataclass(frozen=True, slots=True)
class ViewFigures:
    """What one view measured."""

    view_class: str
    """One of VIEW_CLASSES."""
    agent: str
    values: dict[str, float]
    """By the names in IMAGE_METRICS; NaN where a metric says nothing."""


def evaluate_run(
    run: RunFolder,
    *,
    sources: Sequence[FrameSource],
    cloud: GaussianCloud | None = None,
    coarse: GaussianCloud | None = None,
    views_per_kind: int = 48,
    rasteriser: Renders | None = None,
    lpips_weights: Path | None = None,
) -> dict[str, Any]:
    """Measure trajectories and the merged map of a run.

    Args:
        run: its trajectories and agent reports are read; ground truth that the sources have and
            the folder lacks is written into it.
        sources: the data the run was made from, opened with the same scale and frames.
        cloud: the merged map in the frame of the largest component; default: map.ply.
        coarse: the map before its fine stage; default: map_coarse.ply, and none where `cloud` is
            given.
        views_per_kind: most views rendered of each kind, spread evenly over agents and time.
        rasteriser: default: the CPU rasteriser.
        lpips_weights: default: where `lpips.find_weights` finds them.

    Returns `ate_rmse_m` and `ate_tracked_rmse_m` {agent: metres} (the former with "joint": one
    alignment for all agents of the largest component; null where there is no ground truth),
    `rpe_rmse` and `rpe_tracked_rmse` {agent: {"translation_m", "rotation_rad"}} over one second,
    `psnr_db`, `ssim`, `ms_ssim`, `lpips`, `depth_l1_m` {"train", "novel", "train_coarse",
    "novel_coarse"} (train = keyframes, novel = frames never used for mapping, coarse = before the
    fine stage), `per_agent` {agent: the same five}, `views` (how many of each were rendered),
    `components` (how many there are) and `unmeasured` {what is null: why}.
    """
    _write_missing_ground_truth(run, sources)
    unmeasured: dict[str, str] = {}
    perceptual = _perceptual(lpips_weights, unmeasured)
    maps = _maps(run, cloud, coarse, unmeasured)
    chosen = choose_views(run, sources, per_kind=views_per_kind) if maps else []
    rasteriser = rasteriser or default_rasteriser()
    figures = [
        item
        for suffix, shown in maps.items()
        for item in _figures(chosen, shown, rasteriser, perceptual=perceptual, suffix=suffix)
    ]
    result = _trajectory_figures(run) | _image_figures(figures)
    agents = dict.fromkeys(item.agent for item in figures)
    result["per_agent"] = {
        agent: _image_figures([item for item in figures if item.agent == agent]) for agent in agents
    }
    result["views"] = {kind: sum(v.kind == kind for v in chosen) for kind in VIEW_KINDS}
    if run.components_path.is_file():
        result["components"] = len(run.read_components().members)
    return result | {"unmeasured": unmeasured}


def _write_missing_ground_truth(run: RunFolder, sources: Sequence[FrameSource]) -> None:
    for source in sources:
        if not run.has_trajectory(source.name, "ground_truth"):
            truth = ground_truth_of(source)
            if truth is not None:
                run.write_trajectory(source.name, "ground_truth", truth)


def _perceptual(weights: Path | None, unmeasured: dict[str, str]) -> Perceptual | None:
    from magic_core.evaluation.lpips import Lpips, find_weights

    found = find_weights(weights)
    if found is None:
        unmeasured["lpips"] = NO_WEIGHTS
        return None
    return Lpips(found)


def _maps(
    run: RunFolder,
    cloud: GaussianCloud | None,
    coarse: GaussianCloud | None,
    unmeasured: dict[str, str],
) -> dict[str, GaussianCloud]:
    """The maps to measure, by the suffix of their view classes."""
    if cloud is None and run.map_path.is_file():
        cloud = run.read_map()
        if coarse is None and run.coarse_map_path.is_file():
            coarse = run.read_coarse_map()
    if cloud is None:
        unmeasured["maps"] = "the run folder holds no map.ply: it ended before the merge"
    elif coarse is None:
        unmeasured["coarse"] = NO_COARSE_MAP
    found = {"": cloud, "_coarse": coarse}
    return {suffix: shown for suffix, shown in found.items() if shown is not None}


def default_rasteriser() -> Renders:
    """The CPU rasteriser, imported when first needed."""
    from magic_core.render import Rasteriser

    return Rasteriser()


def _figures(
    chosen: Sequence[ChosenView],
    cloud: GaussianCloud,
    rasteriser: Renders,
    *,
    perceptual: Perceptual | None,
    suffix: str,
) -> Iterable[ViewFigures]:
    """Figures alone are kept of each view: its images would add up."""
    for view in compare_views(chosen, cloud, rasteriser, perceptual=perceptual):
        values = {name: getattr(view, name) for name in IMAGE_METRICS}
        yield ViewFigures(view.chosen.kind + suffix, view.chosen.source.name, values)


def _trajectory_figures(run: RunFolder) -> dict[str, Any]:
    accuracy = measure_trajectories(run)
    relative = {"rpe_rmse": accuracy.relative, "rpe_tracked_rmse": accuracy.relative_tracked}
    return {
        "ate_rmse_m": {**accuracy.corrected_m, "joint": accuracy.joint_m},
        "ate_tracked_rmse_m": accuracy.tracked_m,
    } | {
        name: {
            agent: {"translation_m": error.translation_m, "rotation_rad": error.rotation_rad}
            for agent, error in errors.items()
        }
        for name, errors in relative.items()
    }


def _image_figures(figures: Sequence[ViewFigures]) -> dict[str, dict[str, float | None]]:
    """Means by metric and view class; None where there is nothing to take a mean of."""
    return {
        metric: {
            view_class: _mean(
                item.values[metric] for item in figures if item.view_class == view_class
            )
            for view_class in VIEW_CLASSES
        }
        for metric in IMAGE_METRICS
    }


def _mean(values: Iterable[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
