"""Are a recording's poses rigid, slow enough, and in the convention that is documented?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from magic_core.data.check_calibration import scale_remedy
from magic_core.data.consistency import DOCUMENTED, fits
from magic_core.data.findings import Finding
from magic_core.data.sequence import FileSequence
from magic_core.geometry import se3

_PLACES = 8
_NEIGHBOURS = 5  # frames between the two of a pair that are compared
_SENSOR_NOISE = 0.008  # relative difference of depth that needs no other explanation
_ALIKE = 1.5  # times the misfit of the unit as set, which another unit must exceed
_MISFIT = 0.06  # relative difference that noise does not explain


def check_poses(source: FileSequence, *, layout: str) -> Iterator[Finding]:
    """Rigidity, motion per frame, and the convention that brings depth of two frames together."""
    posed = [files.world_from_camera for files in source.files]
    known = np.array([pose for pose in posed if pose is not None])
    if not len(known):
        yield Finding("ground truth", "ok", "none: trajectories will not be measured")
        return
    rotations = known[:, :3, :3]
    skew = float(np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max())
    if skew > 1e-2 or (np.linalg.det(rotations) < 0).any():
        yield Finding("ground truth", "fail", f"rotations are off by {skew:.2g}",
                      "expected 4x4 rigid transforms, row by row")  # fmt: skip
        return
    yield _motion(source, known)
    yield _convention(source, layout)


def _motion(source: FileSequence, poses: np.ndarray) -> Finding:
    relative = se3.inverse(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(relative[:, :3, 3], axis=1) if len(relative) else np.zeros(1)
    turn = np.array([se3.rotation_angle(motion) for motion in relative] or [0.0])
    fast_step, fast_turn = np.percentile(step, 95), np.rad2deg(np.percentile(turn, 95))
    detail = (
        f"{len(poses)} of {len(source)} frames; per frame {1000 * np.median(step):.0f} mm and "
        f"{np.rad2deg(np.median(turn)):.2f} degrees, 95 % below {1000 * fast_step:.0f} mm and "
        f"{fast_turn:.1f} degrees"
    )
    if fast_step > 0.15 or fast_turn > 10:
        return Finding("motion", "warn", detail, "fast for tracking: use every frame, or go slower")
    return Finding("motion", "ok", detail)


def _convention(source: FileSequence, layout: str) -> Finding:
    """Carry depth between neighbouring frames by their poses, read in every usual way."""
    name = "pose convention"
    medians = _misfits(source)
    if not medians:
        return Finding(name, "warn", "the camera hardly moves between frames: not checked",
                       "record a moving camera, or leave the ground truth out")  # fmt: skip
    (convention, factor), best = min(medians.items(), key=lambda item: item[1])
    ours = medians[(DOCUMENTED, 1.0)]
    misfit = f"differs by {100 * ours:.1f} %" if np.isfinite(ours) else "meets nothing"
    detail = f"carried depth {misfit} when read as {DOCUMENTED}"
    if ours <= _SENSOR_NOISE or best > 0.5 * ours:
        if ours <= _MISFIT:
            return Finding(name, "ok", detail + _undecided_unit(medians))
        return Finding(name, "warn", detail, "poses, intrinsics and depth do not fit each other: "
                       "do poses belong to these frames, in this order?")  # fmt: skip
    better = f"{detail}; {100 * best:.1f} % "
    if convention != DOCUMENTED:
        remedy = f"WRONG POSES: they are {convention}; convert them to {DOCUMENTED}"
        return Finding(name, "fail", f"{better}as {convention}", remedy)
    scale = source.intrinsics.depth_scale / factor
    return Finding(name, "fail", f"{better}with depth times {factor:g}",
                   f"WRONG DEPTH SCALE: {scale_remedy(layout, f'{scale:g}')}")  # fmt: skip


def _undecided_unit(medians: dict[tuple[str, float], float]) -> str:
    """Says so where the camera turned without moving: then any depth unit fits the poses."""
    ours = medians[(DOCUMENTED, 1.0)]
    others = [e for (c, factor), e in medians.items() if c == DOCUMENTED and factor in (0.2, 5.0)]
    if min(others) > _ALIKE * ours + _SENSOR_NOISE:
        return ""
    return "; the camera moved too little to tell the depth unit by it"


def _misfits(source: FileSequence) -> dict[tuple[str, float], float]:
    """(convention, depth factor) -> median misfit over places of the recording."""
    starts = np.unique(np.linspace(0, max(len(source) - 1, 0), _PLACES).astype(int))
    errors: dict[tuple[str, float], list[float]] = {}
    for start in starts:
        places = range(int(start), min(int(start) + 3 * _NEIGHBOURS, len(source)), _NEIGHBOURS)
        for fit in fits([source[place] for place in places], source.camera):
            errors.setdefault((fit.convention, fit.depth_factor), []).append(fit.error)
    return {key: float(np.median(values)) for key, values in errors.items()}
