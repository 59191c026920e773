"""Refinement of a pose against the rendered sub-map: what both solvers share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from magic_agent.tracking.config import GaussNewtonConfig
from magic_agent.tracking.gauss_newton import Alignment, GaussNewton, MotionPrior
from magic_agent.tracking.pyramid import Pyramid, view_pyramid
from magic_agent.tracking.result import StageClock
from magic_core.data import Frame
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.render import Rasteriser, RenderedView

Pose = NDArray[np.float64]
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


_FINE_LEVEL = 1  # after the first render only this level and finer ones are solved again


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
    """A refined pose; quality is measured on the last view that was rendered."""

    anchor_from_camera: Pose
    anchor_from_view: Pose
    """Pose of that view."""
    alignment: Alignment
    renders: int

    def information(self, pixels_per_sample: float) -> NDArray[np.float64]:
        """(6, 6) information of anchor_from_camera, right perturbation."""
        view_from_camera = self.alignment.reference_from_camera
        adjoint = se3.adjoint(view_from_camera)
        return adjoint.T @ self.alignment.information(pixels_per_sample) @ adjoint


class Refiner(Protocol):
    """A solver of the pose against the sub-map."""

    def refine(
        self,
        frame: Frame,
        image: Pyramid,
        *,
        anchor_from_camera: Pose,
        reference: ReferenceView,
        clock: StageClock,
    ) -> Refinement:
        """Refine a first estimate of `anchor_from_camera`."""
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
        clock: StageClock,
    ) -> Refinement:
        """The pose of the minimum near the given one; the prior is the given pose itself."""
        config = _without_absent(self._config, frame)
        start, pose = anchor_from_camera, anchor_from_camera
        gain, bias = 1.0, 0.0
        alignment = None
        for count in range(1, config.renders + 1):
            with clock.stage("render"):
                view = reference(pose)
            with clock.stage("refinement"):
                pyramid = view_pyramid(
                    view.image,
                    camera=image.cameras[0],
                    levels=len(image) if count == 1 else min(len(image), _FINE_LEVEL + 1),
                    alpha_power=config.alpha_power,
                )
                alignment = GaussNewton(config).align(
                    pyramid,
                    image,
                    reference_from_camera=np.eye(4),
                    prior=MotionPrior.around(se3.inverse(pose) @ start, config),
                    gain=gain,
                    bias=bias,
                )
            rendered_at, pose = pose, pose @ alignment.reference_from_camera
            gain, bias = alignment.gain, alignment.bias
            if self._moved_pixels(alignment, image) < config.rerender_pixels:
                break
        assert alignment is not None
        return Refinement(pose, rendered_at, alignment, count)

    @staticmethod
    def _moved_pixels(alignment: Alignment, image: Pyramid) -> float:
        """Roughly how far the view moved on the full image, taking a scene at 2 m."""
        motion = alignment.reference_from_camera
        shift = float(np.linalg.norm(motion[:3, 3])) / 2.0 + se3.rotation_angle(motion)
        return image.cameras[0].fx * shift


def _without_absent(config: GaussNewtonConfig, frame: Frame) -> GaussNewtonConfig:
    """Colour does not count in a frame that shows nothing (dark, covered lens)."""
    if contrast(frame) > 0.01:
        return config
    return replace(
        config, photometric=False, residuals=replace(config.residuals, colour_weight=0.0)
    )


def contrast(frame: Frame) -> float:
    """Standard deviation of the green channel of a thinned image, in units of full scale."""
    return float(frame.colour[::8, ::8, 1].std()) / 255.0
