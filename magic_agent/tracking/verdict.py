"""Whether a refined pose is to be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import LostConfig
from magic_agent.tracking.refinement import Refinement, contrast
from magic_agent.tracking.result import Verdict
from magic_core.data import Frame
from magic_core.geometry import se3


@dataclass(frozen=True, slots=True)
class Judgement:
    """The verdict and the figures behind it."""

    verdict: Verdict
    reason: str
    inlier_share: float
    visible_share: float
    eigenvalues: NDArray[np.float64]  # (6,) relative to the motion prior, ascending


def judge(
    frame: Frame,
    refinement: Refinement,
    *,
    previous_from_camera: NDArray[np.float64],
    prior: NDArray[np.float64],
    usual_colour_error: float | None,
    degenerate_below: float,
    config: LostConfig,
) -> Judgement:
    """Lost where the view does not fit, or the motion is impossible; degenerate where the images
    tell less than `degenerate_below` times as much as the motion prior along some direction."""
    fit = refinement.alignment.fits[0]
    visible_share, inlier_share = fit.visible_share, fit.inlier_share
    eigenvalues = relative_eigenvalues(refinement.alignment.information, prior)
    reason = _why_lost(
        frame,
        refinement,
        previous_from_camera=previous_from_camera,
        inlier_share=inlier_share,
        visible_share=visible_share,
        usual_colour_error=usual_colour_error,
        config=config,
    )
    verdict: Verdict = "lost" if reason else "ok"
    if not reason and eigenvalues[0] < degenerate_below:
        weak = int((eigenvalues < degenerate_below).sum())
        verdict = "degenerate"
        reason = f"the images do not show {weak} of 6 directions of motion"
    return Judgement(verdict, reason, inlier_share, visible_share, eigenvalues)


def relative_eigenvalues(
    information: NDArray[np.float64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(6,) ascending eigenvalues of an information matrix where the prior's is the unit."""
    scale = 1.0 / np.sqrt(np.diag(prior))
    return np.linalg.eigvalsh(information * np.outer(scale, scale)).astype(np.float64)


def _why_lost(
    frame: Frame,
    refinement: Refinement,
    *,
    previous_from_camera: NDArray[np.float64],
    inlier_share: float,
    visible_share: float,
    usual_colour_error: float | None,
    config: LostConfig,
) -> str:
    """The first reason not to believe the pose, or an empty string."""
    depth_share = float((frame.depth[::4, ::4] > 0).mean())
    has_depth = depth_share >= config.min_valid_depth_share
    has_colour = contrast(frame) >= config.min_contrast
    if not has_depth and not has_colour:
        return f"the frame shows nothing: depth on {depth_share:.0%}, no contrast"
    jump = float(np.linalg.norm(previous_from_camera[:3, 3]))
    if jump > config.max_jump_m:
        return f"moved {jump:.2f} m in one frame"
    turn = float(np.degrees(se3.rotation_angle(previous_from_camera)))
    if turn > config.max_turn_deg:
        return f"turned {turn:.0f} degrees in one frame"
    if visible_share < config.min_visible_share:
        return f"only {visible_share:.0%} of the image shows the sub-map"
    if has_depth and inlier_share < config.min_inlier_share:
        return f"only {inlier_share:.0%} of the depths agree with the sub-map"
    return _why_colours_differ(refinement, usual_colour_error, config) if has_colour else ""


def _why_colours_differ(
    refinement: Refinement, usual_error: float | None, config: LostConfig
) -> str:
    """Why the colours do not show the same place, or an empty string."""
    fit = refinement.alignment.fits[0]
    error = fit.model.colour_sigma
    limit = config.max_colour_error
    if usual_error is not None:
        limit = max(limit, config.max_colour_growth * usual_error)
    else:
        limit *= 3.0  # nothing to compare with yet
    if error > limit:
        return f"colour residuals of {error:.3f}, at most {limit:.3f} expected"
    surprise = fit.exposure.gain / refinement.exposure.gain
    if not 1.0 / config.max_gain <= surprise <= config.max_gain:
        return f"colours match only with {surprise:.2f} times the gain that was expected"
    return ""
