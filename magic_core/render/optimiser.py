"""Mapping iterations: render, losses, gradients and Adam in one call.

The losses are the paper's: (1 - lambda) L1 + lambda (1 - SSIM) on colour, L1 on depth, and the
regularisation of scales. Nothing is allocated per iteration.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import adam, losses, threads
from magic_core.render.lanes import LANES
from magic_core.render.layout import aligned_zeros
from magic_core.render.rasteriser import Float32, Rasteriser, RenderedView

_WIDTHS = (3, 4, 3, 1, 3)  # values per Gaussian of means, quaternions, scales, opacities, colours


@dataclass(frozen=True, slots=True)
class LearningRates:
    """Adam step sizes per iteration, those of 3DGS."""

    means: float = 1.6e-4
    """Metres."""
    quaternions: float = 1e-3
    scales: float = 5e-3
    """Of the logarithm of a scale."""
    opacities: float = 5e-2
    """Of the logit of an opacity."""
    colours: float = 2.5e-3


@dataclass(frozen=True, slots=True)
class LossWeights:
    """How the parts of the mapping loss are added."""

    colour: float = 1.0
    ssim: float = 0.2
    """Lambda: the share of 1 - SSIM in the colour loss, 0 to 1."""
    depth: float = 1.0
    """Per metre."""
    scale: float = 1.0
    """Per metre: of the mean deviation of scales from their mean."""


@dataclass(frozen=True, slots=True)
class StepReport:
    """The losses of one iteration, before its step."""

    loss: float
    """The weighted sum that was descended."""
    colour_l1: float
    """Mean absolute colour error, 0 to 1."""
    ssim: float
    """Mean structural similarity, 1 is equal."""
    depth_l1: float
    """Mean over the pixels with depth of alpha times the error of expected depth, metres."""


@dataclass(slots=True)
class _Targets:
    """Buffers of one image size."""

    shape: tuple[int, int]
    colour: Float32 = field(init=False)
    maps: Float32 = field(init=False)
    gradient: Float32 = field(init=False)
    row_sums: NDArray[np.float64] = field(init=False)
    valid: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        height, width = self.shape
        pixels = height * width
        self.colour = aligned_zeros(3 * pixels + LANES)
        self.maps = aligned_zeros(9 * height * losses.padded_width.py_func(width))
        self.gradient = aligned_zeros(5 * pixels)
        self.row_sums = np.zeros((height, losses.ROW_SUMS))
        self.valid = np.zeros(height, np.int64)


class GaussianOptimiser:
    """A cloud under optimisation: holds parameters, Adam moments and all buffers."""

    def __init__(
        self,
        gaussians: GaussianCloud,
        *,
        learning_rates: LearningRates | None = None,
        weights: LossWeights | None = None,
        threads: int | None = None,
    ) -> None:
        self.learning_rates = learning_rates or LearningRates()
        self.weights = weights or LossWeights()
        self._rasteriser = Rasteriser(threads)
        self._window = losses.ssim_window()
        self._targets = _Targets((1, 1))
        self._no_weight = np.ones(1, np.float32)
        self._count = 0
        self._allocate(0)
        self.extend(gaussians)

    def __len__(self) -> int:
        return self._count

    def gaussians(self) -> GaussianCloud:
        """A copy of the cloud in natural values."""
        n = self._count
        parts = [a[: k * n].copy() for a, k in zip(self._natural, _WIDTHS, strict=True)]
        means, quaternions, scales, opacities, colours = parts
        return GaussianCloud(
            means.reshape(n, 3), quaternions.reshape(n, 4), scales.reshape(n, 3), opacities,
            colours.reshape(n, 3),
        )  # fmt: skip

    def render(self, camera: Camera, world_from_camera: ArrayLike) -> RenderedView:
        """Render the cloud as it is."""
        return self._rasteriser.render_flat(self._active(), camera, world_from_camera)

    def step(
        self,
        camera: Camera,
        world_from_camera: ArrayLike,
        colour: NDArray[np.uint8],
        depth: Float32,
        *,
        weight: Float32 | None = None,
    ) -> StepReport:
        """One iteration on one RGB-D image.

        colour (h, w, 3) uint8 RGB, depth (h, w) metres with 0 = no reading, weight (h, w) of each
        pixel in all image losses (None: 1). Gaussians that are not drawn keep their values.
        """
        check_images(camera, colour, depth, weight)
        self._rasteriser.forward(self._active(), camera, world_from_camera)
        report = self._image_losses(colour, depth, weight)
        self._rasteriser.accumulate(
            self._targets.gradient[: 5 * depth.size].reshape(5, *depth.shape)
        )
        deviation = self._adam()
        scale_loss = self.weights.scale * deviation / max(self._count, 1)
        return StepReport(report.loss + scale_loss, report.colour_l1, report.ssim, report.depth_l1)

    def extend(self, cloud: GaussianCloud) -> None:
        """Add Gaussians, with fresh moments, behind the present ones."""
        old, new = self._count, len(cloud)
        self._reserve(old + new)
        self._count = old + new
        for array, part, k in zip(self._natural, cloud.arrays(), _WIDTHS, strict=True):
            array[k * old : k * (old + new)] = part.reshape(-1)
        opacities = np.clip(cloud.opacities, 1e-6, 1 - 1e-6)
        rows = self._state[:, old : old + new]
        rows[adam.MEAN : adam.QUATERNION] = cloud.means.T
        rows[adam.QUATERNION : adam.LOG_SCALE] = cloud.quaternions.T
        rows[adam.LOG_SCALE : adam.LOGIT] = np.log(np.maximum(cloud.scales, 1e-6)).T
        rows[adam.LOGIT] = np.log(opacities / (1 - opacities))
        rows[adam.COLOUR :] = cloud.colours.T
        for moment in (self._moments, self._squares):
            moment[:, old : old + new] = 0
        self._steps[old : old + new] = 0

    def prune(self, keep_mask: NDArray[np.bool_]) -> None:
        """Keep the Gaussians of a (n,) mask, with their moments, in their order."""
        if keep_mask.shape != (self._count,):
            text = f"shape {keep_mask.shape}, expected ({self._count},)"
            raise InvalidInput.field("keep_mask", text)
        n, kept = self._count, int(np.count_nonzero(keep_mask))
        for array in (self._state, self._moments, self._squares):
            array[:, :kept] = array[:, :n][:, keep_mask]
        self._steps[:kept] = self._steps[:n][keep_mask]
        for array, k in zip(self._natural, _WIDTHS, strict=True):
            array[: k * kept] = array[: k * n].reshape(n, k)[keep_mask].reshape(-1)
        self._count = kept

    def _active(self) -> tuple[Float32, ...]:
        """Flat natural parameters of the present Gaussians (views)."""
        return tuple(a[: k * self._count] for a, k in zip(self._natural, _WIDTHS, strict=True))

    def _image_losses(
        self, colour: NDArray[np.uint8], depth: Float32, weight: Float32 | None
    ) -> StepReport:
        """Fill the image gradient and sum the losses of colour and depth."""
        if self._targets.shape != depth.shape:
            self._targets = _Targets(depth.shape)
        t, w = self._targets, self.weights
        height, width = depth.shape
        flat_depth = np.ascontiguousarray(depth, np.float32).reshape(-1)
        size = (width, height)
        run, many = threads.run, self._rasteriser.threads
        flat_colour = np.ascontiguousarray(colour).reshape(-1)
        run(
            losses.prepare_target,
            (flat_colour, *size, flat_depth, t.colour, t.valid), threads=many,
        )  # fmt: skip
        values, valid = 3 * depth.size, max(int(t.valid.sum()), 1)
        flat_weight = self._no_weight
        if weight is not None:
            flat_weight = np.ascontiguousarray(weight, np.float32).reshape(-1)
        weighting = (flat_weight, weight is not None, self._window)
        image = self._rasteriser.image_with_margin
        ssim_share = np.float32(-w.colour * w.ssim / values)
        run(
            losses.ssim_maps,
            (image, t.colour, *size, *weighting, ssim_share, t.maps, t.row_sums), threads=many,
        )  # fmt: skip
        l1_share = np.float32(w.colour * (1 - w.ssim) / values)
        run(
            losses.image_gradient,
            (image, t.colour, *size, flat_depth, *weighting, t.maps, l1_share,
             np.float32(w.depth / valid), t.gradient, t.row_sums), threads=many,
        )  # fmt: skip
        l1, ssim, depth_l1 = t.row_sums.sum(axis=0) / (values, values, valid)
        total_weight = 1.0 if weight is None else float(flat_weight.mean())
        loss = w.colour * ((1 - w.ssim) * l1 + w.ssim * (total_weight - ssim)) + w.depth * depth_l1
        return StepReport(float(loss), float(l1), float(ssim), float(depth_l1))

    def _adam(self) -> float:
        """Step the parameters; returns the sum of |s - mean s| before it."""
        r, rates = self._rasteriser, self.learning_rates
        mean, deviation, sign = adam.scale_statistics(self._natural[2], 3 * self._count)
        settings = np.array(
            [rates.means, rates.quaternions, rates.scales, rates.opacities, rates.colours,
             mean, self.weights.scale / max(self._count, 1), sign], np.float32,
        )  # fmt: skip
        threads.run(
            adam.adam_step,
            (self._count, r.touched, *r.d_parameters, settings, self._room,
             self._state.reshape(-1), self._moments.reshape(-1), self._squares.reshape(-1),
             self._steps, *self._natural), threads=r.threads,
        )  # fmt: skip
        return deviation

    def _allocate(self, room: int) -> None:
        self._room = room + LANES
        self._natural = tuple(aligned_zeros(k * self._room) for k in _WIDTHS)
        shape = (adam.ROWS, self._room)
        self._state, self._moments, self._squares = (
            aligned_zeros(adam.ROWS * self._room).reshape(shape) for _ in range(3)
        )
        self._steps = aligned_zeros(self._room)

    def _reserve(self, count: int) -> None:
        """Grow the arrays to hold `count` Gaussians and one vector more."""
        if count + LANES <= self._room:
            return
        n = self._count
        before = (self._state, self._moments, self._squares)
        natural, steps = self._natural, self._steps
        self._allocate(count + count // 2)
        for new, old in zip((self._state, self._moments, self._squares), before, strict=True):
            new[:, :n] = old[:, :n]
        self._steps[:n] = steps[:n]
        for new, old, k in zip(self._natural, natural, _WIDTHS, strict=True):
            new[: k * n] = old[: k * n]


def check_images(
    camera: Camera, colour: NDArray[np.uint8], depth: Float32, weight: Float32 | None
) -> None:
    """Raise InvalidInput unless the images of a step have the camera's size and their types."""
    shape = (camera.height, camera.width)
    if colour.shape != (*shape, 3) or colour.dtype != np.uint8:
        text = f"{colour.dtype} {colour.shape}, expected uint8 {(*shape, 3)}"
        raise InvalidInput.field("colour", text)
    if depth.shape != shape:
        raise InvalidInput.field("depth", f"shape {depth.shape}, expected {shape}")
    if weight is not None and weight.shape != shape:
        raise InvalidInput.field("weight", f"shape {weight.shape}, expected {shape}")
