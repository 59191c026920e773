"""Coarse-to-fine Levenberg-Marquardt alignment of an RGB-D image with reference views.

The residuals and their derivatives are those of `magic_core.render.linearisation`. What is
estimated is `anchor_from_camera`, updated on the right (T <- T exp(xi)), and one gain and bias of
the image against each view. Several views, the rendered sub-map and keyframes, add up: each gives
normal equations in its own frame, left perturbation of view_from_camera, and as
exp(x) T = T exp(Ad(T)^-1 x), its part in the camera's frame is Ad^T H Ad and Ad^T b.

A motion prior joins as one more measurement; it is weak, so that it decides only along directions
which the images leave open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import GaussNewtonConfig
from magic_agent.tracking.exposure import SAME, Exposure
from magic_agent.tracking.pyramid import Pyramid
from magic_core.geometry import Camera, se3
from magic_core.render.linearisation import (
    NormalEquations,
    ResidualModel,
    estimate_scales,
    linearise,
)

Float64 = NDArray[np.float64]

_FIRST_DAMPING = 1e-4
_MEDIAN_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class View:
    """A reference view and where it was taken."""

    pyramid: Pyramid
    """Reference levels (5, h, w); levels finer than `finest` may be empty."""
    anchor_from_view: Float64  # (4, 4)
    finest: int = 0
    """The finest level to look at; below, the view's last normal equations stand for it."""
    exposure: Exposure = SAME
    """The expected correction of the image to this view's exposure."""


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """Where motion is expected to lead, and how far off that may be."""

    anchor_from_camera: Float64  # (4, 4)
    information: Float64  # (6, 6), right perturbation

    @classmethod
    def around(cls, anchor_from_camera: Float64, config: GaussNewtonConfig) -> MotionPrior:
        """The prior with the deviations of the configuration."""
        translation = 1.0 / config.prior_translation_m**2
        rotation = 1.0 / np.radians(config.prior_rotation_deg) ** 2
        return cls(anchor_from_camera, np.diag([translation] * 3 + [rotation] * 3))


@dataclass(frozen=True, slots=True)
class ViewFit:
    """How the image fits one view at the solution, on the finest level that was looked at."""

    equations: NormalEquations
    model: ResidualModel
    """With the scales that were estimated on that level."""
    exposure: Exposure
    """Correction of the image to the view's exposure."""
    level: int
    """That level."""
    pixels: int
    """Number of its pixels."""

    @property
    def visible_share(self) -> float:
        """Share of the view, weighted by its mask, that falls into the image."""
        return self.equations.visible / self.pixels

    @property
    def inlier_share(self) -> float:
        """Share of the depths seen in both that agree."""
        return self.equations.agreeing / max(self.equations.measured, 1e-9)


@dataclass(frozen=True, slots=True)
class Alignment:
    """A solution and what is known of its quality."""

    anchor_from_camera: Float64  # (4, 4)
    fits: tuple[ViewFit, ...]
    """One per view, in the order given."""
    information: Float64
    """(6, 6) of anchor_from_camera from the images alone, right perturbation, gains and biases
    eliminated; correlated pixels are accounted for."""


class GaussNewton:
    """The solver; holds settings only."""

    def __init__(self, config: GaussNewtonConfig) -> None:
        self._config = config

    def align(
        self,
        views: Sequence[View],
        image: Pyramid,
        *,
        anchor_from_camera: Float64,
        prior: MotionPrior | None = None,
        coarsest: int | None = None,
        finest: int | None = None,
    ) -> Alignment:
        """Align from the coarsest to the finest level (inclusive), starting at the given pose."""
        last = self._config.finest_level if finest is None else finest
        first = len(image) - 1 if coarsest is None else min(coarsest, len(image) - 1)
        terms = [_Term(view, image, self._config) for view in views]
        pose = anchor_from_camera
        for level in range(first, min(last, first) - 1, -1):
            pose = self._solve_level(terms, level, pose, prior)
        return self._alignment(terms, pose)

    def evaluate(
        self, views: Sequence[View], image: Pyramid, *, anchor_from_camera: Float64
    ) -> Alignment:
        """The quality of a pose that was found elsewhere, on the full image."""
        terms = [_Term(view, image, self._config) for view in views]
        for term in terms:
            term.begin_level(0, anchor_from_camera)
        return self._alignment(terms, anchor_from_camera)

    def _alignment(self, terms: list[_Term], pose: Float64) -> Alignment:
        information = sum((term.current.hessian for term in terms), np.zeros((6, 6)))
        information = information / self._config.pixels_per_sample
        return Alignment(pose, tuple(term.fit() for term in terms), information)

    def _solve_level(
        self, terms: list[_Term], level: int, pose: Float64, prior: MotionPrior | None
    ) -> Float64:
        config = self._config
        for term in terms:
            term.begin_level(level, pose)
        cost, damping = self._cost(terms, pose, prior), _FIRST_DAMPING
        for _ in range(config.iterations[min(level, len(config.iterations) - 1)]):
            step = self._step(terms, pose, prior=prior, damping=damping)
            trial = pose @ se3.exp(step)
            for term in terms:
                term.try_pose(trial, step)
            trial_cost = self._cost(terms, trial, prior)
            if trial_cost <= cost:
                pose, cost, damping = trial, trial_cost, max(damping * 0.1, 1e-7)
            else:
                damping *= 30.0
                for term in terms:
                    term.step_back()
            if pixels_moved(step, terms[0].camera) < config.converged_pixels:
                break
        return pose

    def _cost(self, terms: list[_Term], pose: Float64, prior: MotionPrior | None) -> float:
        """Mean robust cost per visible pixel, with the priors' share."""
        total = sum(term.current.cost for term in terms)
        if prior is not None:
            deviation = se3.log(se3.inverse(prior.anchor_from_camera) @ pose)
            quadratic = float(deviation @ prior.information @ deviation)
            total += 0.5 * self._config.pixels_per_sample * quadratic
        return total / max(sum(term.current.visible for term in terms), 1e-9)

    def _step(
        self, terms: list[_Term], pose: Float64, *, prior: MotionPrior | None, damping: float
    ) -> Float64:
        """(6,) damped step of the pose."""
        hessian = sum((term.current.hessian for term in terms), np.zeros((6, 6)))
        gradient = sum((term.current.gradient for term in terms), np.zeros(6))
        if prior is not None:
            weighted = self._config.pixels_per_sample * prior.information
            hessian = hessian + weighted
            deviation = se3.log(se3.inverse(prior.anchor_from_camera) @ pose)
            gradient = gradient + weighted @ deviation
        damped = hessian + np.diag(damping * np.diag(hessian) + 1e-9)
        return np.asarray(np.linalg.solve(damped, -gradient), np.float64)


@dataclass(frozen=True, slots=True)
class _Linearisation:
    """One view's part at one pose, in the camera's frame; gain and bias are eliminated."""

    hessian: Float64  # (6, 6)
    gradient: Float64  # (6,)
    photometric_step: Float64  # (2,) best change of gain and bias while the pose stays
    photometric_slope: Float64  # (2, 6) further change of them per unit of the pose's step
    cost: float
    visible: float


class _Term:
    """One view's share of the problem: its state (gain, bias, scales) and last linearisation."""

    def __init__(self, view: View, image: Pyramid, config: GaussNewtonConfig) -> None:
        self._view = view
        self._image = image
        self._config = config
        self._view_from_anchor = se3.inverse(view.anchor_from_view)
        self._expected = np.array([view.exposure.gain, view.exposure.bias])
        self._photometric = self._expected
        self._model = config.residuals
        self._level = -1
        self._frozen: Float64 | None = None

    @property
    def camera(self) -> Camera:
        """The camera of the level that is being solved."""
        return self._view.pyramid.cameras[self._level]

    def begin_level(self, level: int, pose: Float64) -> None:
        """Estimate the scales at this pose and linearise; a level too fine freezes the view."""
        if self._level >= 0 and level < self._view.finest:
            self._frozen = pose if self._frozen is None else self._frozen
            self._before = (self.current, self._photometric)
            return
        self._level = max(level, self._view.finest)
        model = self._config.residuals
        if self._image_is_dark():
            model = replace(model, colour_weight=0.0)
        model = estimate_scales(*self._levels(), model=model, **self._arguments(pose))
        # The paper counts medians, the gate counts standard deviations.
        self._model = model.with_gate(self._config.inlier_factor / _MEDIAN_TO_SIGMA)
        self.current = self._linearise(pose)

    def try_pose(self, pose: Float64, step: Float64) -> None:
        """Move to a trial pose; `step_back` returns."""
        self._before = (self.current, self._photometric)
        if self._frozen is not None:
            self.current = self._moved_quadratic(step)
            return
        change = self.current.photometric_step + self.current.photometric_slope @ step
        self._photometric = self._photometric + change
        self.current = self._linearise(pose)

    def step_back(self) -> None:
        """Undo the last `try_pose`."""
        self.current, self._photometric = self._before

    def fit(self) -> ViewFit:
        """How the image fits this view now."""
        exposure = Exposure(*self._photometric.tolist())
        size = self.camera.width * self.camera.height
        return ViewFit(self._equations, self._model, exposure, self._level, size)

    def _levels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self._view.pyramid.levels[self._level], self._image.levels[self._level]

    def _arguments(self, pose: Float64) -> dict:
        gain, bias = self._photometric
        return {
            "camera": self.camera,
            "camera_from_reference": se3.inverse(self._view_from_anchor @ pose),
            "gain": float(gain),
            "bias": float(bias),
        }

    def _image_is_dark(self) -> bool:
        return float(self._image.levels[-1][..., 1].std()) < self._config.min_contrast

    def _linearise(self, pose: Float64) -> _Linearisation:
        config = self._config
        equations = linearise(*self._levels(), model=self._model, **self._arguments(pose))
        self._equations = equations
        adjoint = se3.adjoint(self._view_from_anchor @ pose)
        hessian = adjoint.T @ equations.hessian[:6, :6] @ adjoint
        gradient = adjoint.T @ equations.gradient[:6]
        if not config.photometric or self._model.colour_weight == 0.0:
            return _Linearisation(
                hessian, gradient, np.zeros(2), np.zeros((2, 6)), equations.cost, equations.visible
            )
        weight = config.pixels_per_sample * np.array(
            [config.gain_deviation**-2.0, config.bias_deviation**-2.0]
        )
        off = self._photometric - self._expected
        coupling = adjoint.T @ equations.hessian[:6, 6:]
        inverse = np.linalg.inv(equations.hessian[6:, 6:] + np.diag(weight))
        slope = equations.gradient[6:] + weight * off
        return _Linearisation(
            hessian=hessian - coupling @ inverse @ coupling.T,
            gradient=gradient - coupling @ inverse @ slope,
            photometric_step=-inverse @ slope,
            photometric_slope=-inverse @ coupling.T,
            cost=equations.cost + 0.5 * float(weight @ off**2),
            visible=equations.visible,
        )

    def _moved_quadratic(self, step: Float64) -> _Linearisation:
        """The last linearisation as a function of the pose, at a step from where it stood."""
        last = self.current
        moved = last.hessian @ step
        return replace(
            last,
            gradient=last.gradient + moved,
            cost=last.cost + float(last.gradient @ step + 0.5 * step @ moved),
        )


def pixels_moved(step: Float64, camera: Camera) -> float:
    """Roughly how far a step moves the image, taking a scene at 2 m."""
    return camera.fx * float(np.linalg.norm(step[3:6]) + np.linalg.norm(step[:3]) / 2.0)
