"""The tracker of one camera: where was this frame taken, and can that be believed?

A frame passes through: prediction (constant velocity), rotation pre-alignment where the
prediction does not fit, registration to the previous frame, refinement against the rendered
sub-map, and a verdict. The sub-map enters as a function that renders it, so the tracker knows no
mapper. Poses are relative to the sub-map's anchor.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import TrackingConfig
from magic_agent.tracking.exposure import SAME, exposure_jump
from magic_agent.tracking.gauss_newton import MotionPrior
from magic_agent.tracking.initialisation import InitialPose, make_initialiser
from magic_agent.tracking.keyframe_window import KeyframeWindow
from magic_agent.tracking.pyramid import Pyramid
from magic_agent.tracking.pyramid_cache import PyramidCache
from magic_agent.tracking.refinement import (
    GaussNewtonRefiner,
    ReferenceView,
    Refinement,
    Refiner,
    contrast,
)
from magic_agent.tracking.relocalisation import Relocaliser
from magic_agent.tracking.result import StageClock, TrackingResult
from magic_agent.tracking.rotation import align_rotation
from magic_agent.tracking.verdict import judge
from magic_core.data import Frame
from magic_core.geometry import Camera, se3
from magic_core.submap import Keyframe

logger = logging.getLogger(__name__)

Pose = NDArray[np.float64]

_TURN_GAIN = 0.6  # pre-alignment must bring the colour cost below this share to be believed


class Tracker:
    """Finds the pose of one frame after another; keeps nothing but prepared images."""

    def __init__(self, camera: Camera, config: TrackingConfig | None = None) -> None:
        self._camera = camera
        self._config = config or TrackingConfig()
        self._pyramids = PyramidCache(camera, self._config.gauss_newton.levels)
        self._initialiser = make_initialiser(self._config, self._pyramids)
        self._refiner = _make_refiner(self._config)
        self._window = KeyframeWindow(self._config.window)
        self._relocaliser: Relocaliser | None = None
        self._usual_colour_error: float | None = None
        self._exposure = SAME

    @property
    def config(self) -> TrackingConfig:
        """The settings in force."""
        return self._config

    def reset(self) -> None:
        """Forget the frames seen so far (after a jump of the camera or a lost track)."""
        self._initialiser.reset()
        self._window.clear()

    def begin_chain(self) -> None:
        """Forget also how earlier sub-maps looked: the next one shares nothing with them."""
        self.reset()
        self._usual_colour_error, self._exposure = None, SAME

    def submap_reexposed(self) -> None:
        """Expect the next image to be as bright as the sub-map, which now has the exposure of the
        last one: it was brought there."""
        self._exposure = SAME

    def track(
        self,
        frame: Frame,
        previous: Frame,
        *,
        anchor_from_previous: Pose,
        anchor_from_before_previous: Pose | None = None,
        reference: ReferenceView,
    ) -> TrackingResult:
        """Find `anchor_from_camera` of a frame.

        Args:
            frame: the new frame.
            previous: the frame before it, tracked successfully.
            anchor_from_previous: its pose.
            anchor_from_before_previous: the pose of the frame before that, for the prediction;
                None predicts no motion.
            reference: renders the sub-map as seen from a pose `anchor_from_camera`.
        """
        clock = StageClock()
        predicted = _constant_velocity(anchor_from_previous, anchor_from_before_previous)
        with clock.stage("pyramid"):
            image = self._pyramids.get(frame)
            before = self._pyramids.get(previous)
            self._window.start(previous, before)
            jump = exposure_jump(before, image)
            shown = frame if jump == SAME else jump.corrected(frame)
        with clock.stage("rotation"):
            predicted = self._turned(before, self._pyramids.get(shown), predicted)
        with clock.stage("initialisation"):
            start = self._start(shown, previous, predicted)
        refinement = self._refiner.refine(
            frame,
            image,
            anchor_from_camera=anchor_from_previous @ start.previous_from_current,
            reference=reference,
            keyframes=self._window.views(anchor_from_previous, jump=jump),
            initialised=start.ok and self._config.initialisation != "constant_velocity",
            expected=anchor_from_previous @ predicted,
            exposure=self._exposure.after(jump),
            clock=clock,
        )
        result = self._result(
            frame,
            refinement,
            anchor_from_previous=anchor_from_previous,
            predicted=predicted,
            clock=clock,
        )
        if not result.lost and self._config.solver == "gauss_newton":
            self._window.advance(
                frame,
                image,
                last_from_frame=se3.inverse(anchor_from_previous) @ result.anchor_from_camera,
                fits=refinement.alignment.fits[1:],
            )
        return result

    def refine(
        self, frame: Frame, *, anchor_from_camera: Pose, reference: ReferenceView
    ) -> TrackingResult:
        """Refine a pose that is known already, without a previous frame: at the seam between
        sub-maps, or after relocalisation."""
        clock = StageClock()
        with clock.stage("pyramid"):
            image = self._pyramids.get(frame)
        refinement = self._refiner.refine(
            frame, image, anchor_from_camera=anchor_from_camera, reference=reference, clock=clock
        )
        return self._result(
            frame,
            refinement,
            anchor_from_previous=anchor_from_camera,
            predicted=np.eye(4),
            clock=clock,
        )

    def relocalise(
        self, frame: Frame, keyframes: Sequence[Keyframe], *, reference: ReferenceView
    ) -> TrackingResult | None:
        """Find a frame in the active sub-map from its keyframes alone; None if it is not there."""
        if self._relocaliser is None:
            self._relocaliser = Relocaliser(self._camera, self._config.relocalisation)
        clock = StageClock()
        with clock.stage("relocalisation"):
            found = self._relocaliser.relocalise(
                frame,
                keyframes,
                refine=lambda pose: self.refine(
                    frame, anchor_from_camera=pose, reference=reference
                ),
            )
        return None if found is None else replace(found, stages_ms=clock.stages_ms)

    def _turned(self, previous: Pyramid, current: Pyramid, predicted: Pose) -> Pose:
        """The prediction, turned where tiny images show a turn that it did not foresee."""
        if not self._config.rotation_prealignment:
            return predicted
        fit = align_rotation(previous, current, previous_from_current=predicted)
        if fit is None or fit.cost_after >= _TURN_GAIN * fit.cost_before:
            return predicted
        return fit.previous_from_current

    def _start(self, frame: Frame, previous: Frame, predicted: Pose) -> InitialPose:
        """The motion before refinement."""
        initial = self._initialiser.estimate(
            previous, frame, camera=self._camera, predicted_previous_from_current=predicted
        )
        if not initial.ok:
            logger.debug("frame %d: initialisation failed, using the prediction", frame.index)
        return initial

    def _note_colour_error(self, error: float) -> None:
        """Follow the usual colour error slowly."""
        usual = self._usual_colour_error
        self._usual_colour_error = error if usual is None else usual + 0.1 * (error - usual)

    def _result(
        self,
        frame: Frame,
        refinement: Refinement,
        *,
        anchor_from_previous: Pose,
        predicted: Pose,
        clock: StageClock,
    ) -> TrackingResult:
        prior = MotionPrior.around(np.eye(4), self._config.gauss_newton).information
        alignment = refinement.alignment
        judgement = judge(
            frame,
            refinement,
            previous_from_camera=se3.inverse(anchor_from_previous) @ alignment.anchor_from_camera,
            prior=prior,
            usual_colour_error=self._usual_colour_error,
            degenerate_below=self._config.gauss_newton.degenerate_below,
            config=self._config.lost,
        )
        lost = judgement.verdict == "lost"
        fit = alignment.fits[0]
        if not lost and contrast(frame) >= self._config.lost.min_contrast:
            self._note_colour_error(fit.model.colour_sigma)
            self._exposure = fit.exposure
        return TrackingResult(
            anchor_from_camera=(
                anchor_from_previous @ predicted if lost else alignment.anchor_from_camera
            ),
            information=prior if lost else alignment.information + prior,
            verdict=judgement.verdict,
            reason=judgement.reason,
            inlier_share=judgement.inlier_share,
            visible_share=judgement.visible_share,
            cost=fit.equations.mean_cost,
            colour_error=fit.model.colour_sigma,
            eigenvalues=judgement.eigenvalues,
            gain=fit.exposure.gain,
            bias=fit.exposure.bias,
            renders=refinement.renders,
            stages_ms=clock.stages_ms,
        )


def _make_refiner(config: TrackingConfig) -> Refiner:
    if config.solver == "adam":
        from magic_agent.tracking.adam import AdamRefiner  # loads torch only when asked for

        return AdamRefiner(config.adam, config.gauss_newton)
    return GaussNewtonRefiner(config.gauss_newton)


def _constant_velocity(anchor_from_previous: Pose, anchor_from_before: Pose | None) -> Pose:
    """previous_from_current if the last motion repeats itself."""
    if anchor_from_before is None:
        return se3.identity()
    return se3.orthonormalised(se3.inverse(anchor_from_before) @ anchor_from_previous)
