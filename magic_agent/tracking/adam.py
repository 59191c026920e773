"""The paper's tracker: Adam on the re-rendering loss, one render and one backward per step.

    L = sum M_inlier M_alpha (lambda_c |I' - I|_1 + (1 - lambda_c) |D' - D|_1)

(section "Tracking", eq. L_tracking) with the soft alpha mask alpha^3 and the inlier mask that drops
pixels without depth and those whose depth error exceeds 50 medians (supplementary, "Tracking").
As in the implicit trackers that the paper builds on, rotation and translation have learning rates
of their own; here both are the right perturbation of `anchor_from_camera`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import AdamConfig, GaussNewtonConfig
from magic_agent.tracking.exposure import SAME, Exposure
from magic_agent.tracking.gauss_newton import Alignment, GaussNewton, View
from magic_agent.tracking.pyramid import Pyramid, view_pyramid
from magic_agent.tracking.refinement import DifferentiableView, Pose, ReferenceView, Refinement
from magic_agent.tracking.result import StageClock
from magic_core.data import Frame
from magic_core.errors import ConfigError
from magic_core.geometry import se3

Float32 = NDArray[np.float32]

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8


class AdamRefiner:
    """First-order refinement with the paper's loss, masks and learning rates."""

    def __init__(self, config: AdamConfig, quality: GaussNewtonConfig) -> None:
        self._config = config
        self._quality = quality
        self._rates = np.array([config.translation_rate] * 3 + [config.rotation_rate] * 3)

    def refine(
        self,
        frame: Frame,
        image: Pyramid,
        *,
        anchor_from_camera: Pose,
        reference: ReferenceView,
        keyframes: Sequence[View] = (),
        initialised: bool = False,
        expected: Pose | None = None,
        exposure: Exposure | None = None,
        clock: StageClock,
    ) -> Refinement:
        """The pose after all steps, by the sub-map alone; its fit is that of a last render.

        A known jump of the exposure is taken out of the image; the paper's loss has no gain.
        """
        if not isinstance(reference, DifferentiableView):
            raise ConfigError.field(
                "tracking.solver", "adam needs a reference view with gradients (`backward`)"
            )
        pose = anchor_from_camera
        first, second = np.zeros(6), np.zeros(6)
        exposure = exposure or SAME
        target = np.moveaxis(image.levels[0], -1, 0).copy()
        target[:3] = exposure.gain * target[:3] + exposure.bias
        for step in range(1, self._config.iterations + 1):
            with clock.stage("render"):
                view = reference(pose).image
            with clock.stage("loss"):
                gradient = self.loss_gradient(view, target)
            with clock.stage("backward"):
                slope = reference.backward(gradient)
            first = _BETA_1 * first + (1.0 - _BETA_1) * slope
            second = _BETA_2 * second + (1.0 - _BETA_2) * slope**2
            corrected = first / (1.0 - _BETA_1**step)
            spread = np.sqrt(second / (1.0 - _BETA_2**step)) + _EPSILON
            pose = pose @ se3.exp(-self._rates * corrected / spread)
        with clock.stage("render"):
            view = reference(pose).image
        with clock.stage("loss"):
            alignment = self._judged(view, image, pose, exposure)
        return Refinement(alignment, self._config.iterations + 1, exposure)

    def loss_gradient(self, view: Float32, target: Float32) -> Float32:
        """dL / d view (5, h, w) of the paper's loss; target is (4, h, w) colour and depth.

        The rendered depth is compared as expected depth, accumulated depth / alpha; the masks
        are constants, as in the paper.
        """
        config = self._config
        alpha = np.maximum(view[4], 1e-6)
        depth_error = view[3] / alpha - target[3]
        weight = self._mask(view, target, depth_error)
        total = max(float(weight.sum()), 1.0)
        weight = weight / total
        gradient = np.zeros_like(view)
        gradient[:3] = config.colour_weight * weight * np.sign(view[:3] - target[:3])
        by_depth = (1.0 - config.colour_weight) * weight * np.sign(depth_error) / alpha
        gradient[3] = by_depth
        gradient[4] = -by_depth * view[3] / alpha
        return gradient

    def _mask(self, view: Float32, target: Float32, depth_error: Float32) -> Float32:
        """M_inlier M_alpha, (h, w)."""
        valid = (target[3] > 0.0) & (view[4] > 0.05)
        absolute = np.abs(depth_error)
        median = float(np.median(absolute[valid])) if valid.any() else 0.0
        inlier = valid & (absolute <= self._config.inlier_factor * median)
        return np.where(inlier, view[4] ** self._config.alpha_power, 0.0).astype(np.float32)

    def _judged(self, view: Float32, image: Pyramid, pose: Pose, exposure: Exposure) -> Alignment:
        config = self._quality
        pyramid = view_pyramid(
            view, camera=image.cameras[0], levels=1, alpha_power=config.alpha_power
        )
        reference = View(pyramid, pose, exposure=exposure)
        return GaussNewton(config).evaluate([reference], image, anchor_from_camera=pose)
