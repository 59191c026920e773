"""Refinement of a pose against the rendered sub-map: what both solvers share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import GaussNewtonConfig
from magic_agent.tracking.degeneracy import regularised
from magic_agent.tracking.exposure import Exposure, matched
from magic_agent.tracking.gauss_newton import Alignment, GaussNewton, MotionPrior, View
from magic_agent.tracking.pyramid import Pyramid, view_pyramid
from magic_agent.tracking.result import StageClock
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import Rasteriser, RenderedView

Pose = NDArray[np.float64]
_OPAQUE = 0.7  # mask of a pixel that shows the sub-map and nothing else
ReferenceView = Callable[[Pose], RenderedView]
"""Renders the sub-map as seen from a pose `anchor_from_camera`."""


@runtime_checkable
class DifferentiableView(Protocol):
    """A reference view with gradients, which first-order solvers need."""

    def __call__(self, anchor_from_camera: Pose) -> RenderedView:
        """Render the sub-map."""
        ...

    def backward(self, gradient: NDArray[np.float32]) -> NDArray[np.float64]:
        """(6,) gradient by the right perturbation of the pose of the last render, given the
        loss's gradient by its image (5, h, w)."""
        ...


class CloudView:
    """A cloud of Gaussians as a reference view with gradients: the sub-map for the Adam solver."""

    def __init__(self, cloud: GaussianCloud, camera: Camera, *, threads: int | None = None) -> None:
        self._cloud, self._camera = cloud, camera
        self._rasteriser = Rasteriser(threads)

    def __call__(self, anchor_from_camera: Pose) -> RenderedView:
        """Render the cloud, anchor frame."""
        return self._rasteriser.render(self._cloud, self._camera, anchor_from_camera)

    def backward(self, gradient: NDArray[np.float32]) -> NDArray[np.float64]:
        """(6,) gradient by the right perturbation of the last pose."""
        return self._rasteriser.backward(gradient).pose


@dataclass(frozen=True, slots=True)
class Refinement:
    """A refined pose and its fit; the first of its views is the sub-map as last rendered."""

    alignment: Alignment
    renders: int
    exposure: Exposure
    """The correction to the sub-map's exposure that was expected."""


class Refiner(Protocol):
    """A solver of the pose against the sub-map."""

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
        """Refine a first estimate of `anchor_from_camera`.

        keyframes: further views to align with. initialised: the estimate comes from images, not
        from a prediction, and is good to a pixel or two. expected: where the motion prior expects
        the camera; None expects it at the first estimate. exposure: the expected correction of the
        image to the sub-map's exposure; None compares it with the first render.
        """
        ...


class GaussNewtonRefiner:
    """Render, align coarse to fine, and render again only where the pose moved far."""

    def __init__(self, config: GaussNewtonConfig) -> None:
        self._config = config

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
        """The pose of the minimum near the given one; the prior along degenerate directions."""
        config = self._config
        prior = MotionPrior.around(anchor_from_camera if expected is None else expected, config)
        pose = anchor_from_camera
        for count in range(1, config.renders + 1):
            with clock.stage("render"):
                rendered = reference(pose)
            with clock.stage("refinement"):
                fine = count > 1 or initialised
                coarsest = min(len(image) - 1, config.initialised_level if fine else len(image))
                pyramid = view_pyramid(
                    rendered.image,
                    camera=image.cameras[0],
                    levels=coarsest + 1,
                    alpha_power=config.alpha_power,
                )
                if exposure is None:
                    exposure = _exposure_against(pyramid, image)
                views = [View(pyramid, pose, exposure=exposure), *keyframes]
                alignment = GaussNewton(config).align(
                    views,
                    image,
                    anchor_from_camera=pose,
                    prior=prior,
                    coarsest=coarsest,
                )
            moved = se3.inverse(pose) @ alignment.anchor_from_camera
            pose = alignment.anchor_from_camera
            if count == config.renders or self._pixels(moved, image) < config.rerender_pixels:
                with clock.stage("verdict"):
                    alignment = regularised(alignment, views, image, prior=prior, config=config)
                return Refinement(alignment, count, exposure)
        raise AssertionError("unreachable: renders is at least 1")

    @staticmethod
    def _pixels(motion: Pose, image: Pyramid) -> float:
        """Roughly how far a motion moves the full image, taking a scene at 2 m."""
        shift = float(np.linalg.norm(motion[:3, 3])) / 2.0 + se3.rotation_angle(motion)
        return image.cameras[0].fx * shift


def _exposure_against(view: Pyramid, image: Pyramid) -> Exposure:
    """The image's correction to the exposure of a view of (nearly) the same place."""
    reference = view.levels[-1]
    shown = reference[4] > _OPAQUE
    seen = image.levels[len(view) - 1]
    return matched(reference[:3].mean(axis=0)[shown], seen[..., :3].mean(axis=-1)[shown])


def contrast(frame: Frame) -> float:
    """Standard deviation of the green channel of a thinned image, in units of full scale."""
    return float(frame.colour[::8, ::8, 1].std()) / 255.0
