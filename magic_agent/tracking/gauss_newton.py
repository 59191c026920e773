"""Coarse-to-fine Levenberg-Marquardt alignment of an RGB-D image with a reference view.

The residuals and their derivatives are those of `magic_core.render.linearisation`. What is
estimated is `reference_from_camera`, updated on the left (T <- exp(xi) T), with gain and bias of
the image. A motion prior joins the normal equations as one more measurement; it is weak, so that
it decides only along directions which the images leave open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import GaussNewtonConfig
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
class Alignment:
    """A solution and what is known of its quality."""

    reference_from_camera: Float64  # (4, 4)
    gain: float
    bias: float
    equations: NormalEquations
    """At the solution, on the finest level that was used; without the motion prior."""
    model: ResidualModel
    """With the scales that were estimated on that level."""
    pixels: int
    """Number of pixels of that level."""

    def information(self, pixels_per_sample: float) -> Float64:
        """(6, 6) information of reference_from_camera, left perturbation; gain, bias eliminated."""
        hessian = self.equations.hessian / pixels_per_sample
        nuisance = hessian[6:, 6:] + 1e-6 * np.eye(2)
        coupling = hessian[:6, 6:]
        information = hessian[:6, :6] - coupling @ np.linalg.solve(nuisance, coupling.T)
        return 0.5 * (information + information.T)


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """Where motion is expected to lead, and how far off that may be."""

    reference_from_camera: Float64  # (4, 4)
    information: Float64  # (6, 6), left perturbation

    @classmethod
    def around(cls, reference_from_camera: Float64, config: GaussNewtonConfig) -> MotionPrior:
        """The prior with the deviations of the configuration."""
        translation = 1.0 / config.prior_translation_m**2
        rotation = 1.0 / np.radians(config.prior_rotation_deg) ** 2
        return cls(reference_from_camera, np.diag([translation] * 3 + [rotation] * 3))


class GaussNewton:
    """The solver; holds settings only."""

    def __init__(self, config: GaussNewtonConfig) -> None:
        self._config = config

    def align(
        self,
        reference: Pyramid,
        image: Pyramid,
        *,
        reference_from_camera: Float64,
        prior: MotionPrior | None = None,
        coarsest: int | None = None,
        finest: int | None = None,
        gain: float = 1.0,
        bias: float = 0.0,
    ) -> Alignment:
        """Align from the coarsest to the finest level (inclusive), starting at the given pose."""
        first = len(reference) - 1 if coarsest is None else min(coarsest, len(reference) - 1)
        last = self._config.finest_level if finest is None else finest
        state = _State(reference_from_camera, gain, bias)
        result = None
        for level in range(first, min(last, first) - 1, -1):
            problem = _Problem(
                reference.levels[level], image.levels[level], reference.cameras[level]
            )
            result = self._solve_level(problem, state, prior=prior, level=level)
            state = _State(result.reference_from_camera, result.gain, result.bias)
        assert result is not None
        return result

    def evaluate(
        self, reference: Pyramid, image: Pyramid, *, reference_from_camera: Float64, level: int = 0
    ) -> Alignment:
        """The quality of a given pose, found elsewhere (gain 1, bias 0)."""
        camera = reference.cameras[level]
        problem = _Problem(reference.levels[level], image.levels[level], camera)
        state = _State(reference_from_camera, 1.0, 0.0)
        model = self._model(problem, state)
        equations = problem.linearise(state, model)
        pixels = camera.width * camera.height
        return Alignment(reference_from_camera, 1.0, 0.0, equations, model, pixels)

    def _solve_level(
        self, problem: _Problem, state: _State, *, prior: MotionPrior | None, level: int
    ) -> Alignment:
        config = self._config
        model = self._model(problem, state)
        equations = problem.linearise(state, model)
        cost = self._cost(equations, state, prior)
        damping = _FIRST_DAMPING
        for _ in range(config.iterations[min(level, len(config.iterations) - 1)]):
            step = self._step(equations, state, prior=prior, damping=damping)
            trial = state.moved(step)
            trial_equations = problem.linearise(trial, model)
            trial_cost = self._cost(trial_equations, trial, prior)
            small = problem.pixels_moved(step) < config.converged_pixels
            if trial_cost <= cost:
                state, equations, cost = trial, trial_equations, trial_cost
                damping = max(damping * 0.1, 1e-7)
            else:
                damping *= 30.0
            if small:
                break
        size = problem.camera.width * problem.camera.height
        return Alignment(
            state.reference_from_camera, state.gain, state.bias, equations, model, size
        )

    def _model(self, problem: _Problem, state: _State) -> ResidualModel:
        """The residual model with scales and the inlier gate of the data at this pose."""
        model = problem.estimate_scales(state, self._config.residuals)
        # The paper counts medians, the gate counts standard deviations.
        return model.with_gate(self._config.inlier_factor / _MEDIAN_TO_SIGMA)

    def _cost(self, equations: NormalEquations, state: _State, prior: MotionPrior | None) -> float:
        """Mean robust cost per pixel, with the priors' share."""
        total = equations.cost + 0.5 * self._config.pixels_per_sample * (
            state.prior_cost(prior) + self._photometric_prior_cost(state)
        )
        return total / max(equations.visible, 1e-9)

    def _photometric_prior_cost(self, state: _State) -> float:
        if not self._config.photometric:
            return 0.0
        return ((state.gain - 1.0) / self._config.gain_deviation) ** 2 + (
            state.bias / self._config.bias_deviation
        ) ** 2

    def _step(
        self,
        equations: NormalEquations,
        state: _State,
        *,
        prior: MotionPrior | None,
        damping: float,
    ) -> Float64:
        """(8,) damped step of pose, gain and bias; the last two are 0 if they are held."""
        config = self._config
        hessian, gradient = equations.hessian.copy(), equations.gradient.copy()
        weight = config.pixels_per_sample
        if prior is not None:
            deviation = state.deviation(prior)
            hessian[:6, :6] += weight * prior.information
            gradient[:6] += weight * prior.information @ deviation
        information = np.array([config.gain_deviation, config.bias_deviation]) ** -2.0
        hessian[(6, 7), (6, 7)] += weight * information
        gradient[6:] += weight * information * (state.gain - 1.0, state.bias)
        free = 8 if config.photometric else 6
        damped = hessian[:free, :free] + np.diag(damping * np.diag(hessian)[:free] + 1e-9)
        step = np.zeros(8)
        step[:free] = np.linalg.solve(damped, -gradient[:free])
        return step


@dataclass(frozen=True, slots=True)
class _State:
    """What is estimated."""

    reference_from_camera: Float64
    gain: float
    bias: float

    def moved(self, step: Float64) -> _State:
        return _State(
            se3.exp(step[:6]) @ self.reference_from_camera,
            self.gain + float(step[6]),
            self.bias + float(step[7]),
        )

    def deviation(self, prior: MotionPrior) -> Float64:
        return se3.log(self.reference_from_camera @ se3.inverse(prior.reference_from_camera))

    def prior_cost(self, prior: MotionPrior | None) -> float:
        if prior is None:
            return 0.0
        deviation = self.deviation(prior)
        return float(deviation @ prior.information @ deviation)


@dataclass(frozen=True, slots=True)
class _Problem:
    """One level's reference view and image."""

    reference: NDArray[np.float32]
    image: NDArray[np.float32]
    camera: Camera

    def linearise(self, state: _State, model: ResidualModel) -> NormalEquations:
        return linearise(
            self.reference,
            self.image,
            camera=self.camera,
            camera_from_reference=se3.inverse(state.reference_from_camera),
            model=model,
            gain=state.gain,
            bias=state.bias,
        )

    def estimate_scales(self, state: _State, model: ResidualModel) -> ResidualModel:
        return estimate_scales(
            self.reference,
            self.image,
            camera=self.camera,
            camera_from_reference=se3.inverse(state.reference_from_camera),
            model=model,
            gain=state.gain,
            bias=state.bias,
        )

    def pixels_moved(self, step: Float64) -> float:
        """Roughly how far a step moves the image, taking a scene at 2 m."""
        return self.camera.fx * float(np.linalg.norm(step[3:6]) + np.linalg.norm(step[:3]) / 2.0)
