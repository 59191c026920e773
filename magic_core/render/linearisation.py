"""Normal equations of one RGB-D image against a reference view: the heart of the tracker.

A *reference view* is what a map (or a keyframe) shows from a known pose: colour R, depth Z and a
soft mask M, one value per pixel p. A new image with colour I and depth D is compared with it
through `camera_from_reference` T. The point X = Z(p) K^-1 p of the reference is seen by the new
camera at q = pi(T X). Two kinds of residual follow, both expressed in the reference frame:

    colour   e_c = R_c(p) - (gain I_c(q) + bias)                     for the three channels c
    depth    e_z = n . (T^-1 (D(q) K^-1 q) - X)                      point to plane, along z

with the plane normal n = (-fx Zu / Z, -fy Zv / Z, 1 + (fx X Zu + fy Y Zv) / Z^2), Zu and Zv being
the central differences of the reference depth. n is scaled so that n . X / Z = 1: an error of the
measured depth appears in e_z unchanged, and so does its variance.

The pose is perturbed on the reference's side, T^-1 <- exp(xi) T^-1 ("inverse compositional"), so
that image gradients are those of the *reference* alone; a rendered image has no sensor noise:

    d e_c / d xi = (Ru, Rv) dpi/dX [I, -hat(X)]      d e_z / d xi = n . [I, -hat(X_measured)]
    d e_c / d gain = -I_c(q)                         d e_c / d bias = -1

Every residual is divided by its standard deviation and robustly weighted (Geman-McClure with
c = `width`): rho(s) = s^2 / 2 / (1 + s^2 / c^2), weight 1 / (1 + s^2 / c^2)^2, and multiplied by
the reference's soft mask M(p), in the paper alpha^3. Pixels whose depth residual exceeds `gate`
standard deviations are left out whole, the paper's inlier mask. The depth's standard deviation
grows with z^2 (structured light, stereo) and with the slope of the surface:

    sigma_z(p)^2 = depth_sigma^2 ((k0 + k2 Z^2)^2 + (k_slope |grad Z|)^2)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera, se3
from magic_core.render import threads as thread_pool
from magic_core.render.residual_kernels import (
    BLOCK_ROWS,
    COLUMNS,
    COST,
    SUMS,
    UNKNOWNS,
    sample_rows,
    sum_blocks,
)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_UPPER = np.triu(np.ones((COLUMNS, COLUMNS), bool))
_WORTH_SHARING = 10_000  # pixels; smaller images are done before a second thread wakes up


@dataclass(frozen=True, slots=True)
class ResidualModel:
    """What is assumed of the residuals; the two sigmas are estimated from the data."""

    colour_sigma: float = 0.03
    """Standard deviation of a colour residual, in units of full scale."""
    depth_sigma: float = 1.0
    """Factor on the depth noise model below, dimensionless."""
    k0_m: float = 0.0015
    """Depth noise at zero range, metres."""
    k2_per_m: float = 0.002
    """Growth of depth noise with z^2, 1 / m."""
    k_slope: float = 0.1
    """Sideways error of a depth pixel, in pixels; counts in proportion to the depth's gradient."""
    colour_width: float = 4.0
    """Geman-McClure width of colour residuals, in standard deviations."""
    depth_width: float = 4.0
    """Geman-McClure width of depth residuals, in standard deviations."""
    colour_weight: float = 1.0
    """Factor on colour information."""
    depth_weight: float = 1.0
    """Factor on depth information."""
    gate: float = 50.0
    """Depth residuals beyond this many standard deviations leave their pixel out."""
    agree: float = 3.5
    """Depth residuals within this many deviations count as agreeing; the noise model's own ones,
    not scaled by `depth_sigma`, or else any two surfaces would agree."""
    depth_step: float = 0.05
    """Neighbouring depths that differ by more than this share of the depth are an edge: unused."""

    def with_gate(self, gate: float) -> ResidualModel:
        """The same model with another inlier gate, in standard deviations."""
        return replace(self, gate=gate)


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Sums over all pixels; unknowns are (translation, rotation, gain, bias)."""

    hessian: Float64  # (8, 8)
    gradient: Float64  # (8,) J^T W e
    cost: float
    """Sum of the robust costs."""
    visible: float
    """Soft count (sum of the mask) of reference pixels that fall into the new image."""
    measured: float
    """Soft count of those where both views have a depth."""
    agreeing: float
    """Soft count of those whose depths agree, by `ResidualModel.agree`."""

    @property
    def mean_cost(self) -> float:
        """Robust cost per visible pixel, comparable between poses."""
        return self.cost / max(self.visible, 1e-9)


def linearise(
    reference: Float32,
    image: Float32,
    *,
    camera: Camera,
    camera_from_reference: Float64,
    model: ResidualModel,
    gain: float = 1.0,
    bias: float = 0.0,
    threads: int | None = None,
) -> NormalEquations:
    """Sum the normal equations of an RGB-D image against a reference view of the same camera.

    Args:
        reference: (5, h, w) planes R, G, B in [0, 1], depth in metres (not accumulated; 0 = none)
            and the soft mask in [0, 1].
        image: (h, w, 4) R, G, B in [0, 1] and depth in metres (0 = no reading), interleaved.
        camera: intrinsics of both.
        camera_from_reference: (4, 4) pose at which to linearise.
        model: noise, robust widths and masks.
        gain, bias: the photometric correction applied to the image.
        threads: how many cores to use (default: `threads.default_threads()`); sums are the same
            whatever their number, because each block of rows is summed on its own.
    """
    height, width = reference.shape[1:]
    blocks = np.zeros((-(-(height - 2) // BLOCK_ROWS), COST + SUMS))
    packed = _packed(camera, camera_from_reference, gain, bias)
    if height * width < _WORTH_SHARING:
        threads = 1
    elif threads is None:
        threads = thread_pool.default_threads()
    arguments = (reference, image, *packed, _packed_model(model), blocks)
    thread_pool.run(sum_blocks, arguments, threads=threads)
    sums = blocks.sum(axis=0)
    upper = sums[:COST].reshape(COLUMNS, COLUMNS)
    gram = np.where(_UPPER, upper, upper.T)
    return NormalEquations(
        gram[:UNKNOWNS, :UNKNOWNS], gram[:UNKNOWNS, UNKNOWNS], *sums[COST:].tolist()
    )


def estimate_scales(
    reference: Float32,
    image: Float32,
    *,
    camera: Camera,
    camera_from_reference: Float64,
    model: ResidualModel,
    gain: float = 1.0,
    bias: float = 0.0,
    samples: int = 2000,
) -> ResidualModel:
    """Replace the model's sigmas by 1.4826 x the median absolute residual at this pose.

    About `samples` pixels of evenly spaced rows are looked at. Scales are kept within bounds so
    that a few perfect or a few absurd pixels cannot make all others worthless.
    """
    height, width = reference.shape[1:]
    step = max(1, round((height - 2) * width / samples))
    packed = _packed(camera, camera_from_reference, gain, bias)
    errors = sample_rows(1 + step // 2, step, reference, image, *packed, _packed_model(model))
    colour, depth = errors[0][errors[0] >= 0.0], errors[1][errors[1] >= 0.0]
    return replace(
        model,
        colour_sigma=_sigma(colour, 0.004, 0.5, otherwise=model.colour_sigma),
        depth_sigma=_sigma(depth, 0.2, 50.0, otherwise=model.depth_sigma),
    )


def _sigma(absolute: Float32, low: float, high: float, *, otherwise: float) -> float:
    if len(absolute) < 32:
        return otherwise
    middle = len(absolute) // 2
    median = float(np.partition(absolute, middle)[middle])
    return min(max(1.4826 * median, low), high)


def _packed(
    camera: Camera, camera_from_reference: Float64, gain: float, bias: float
) -> tuple[Float32, Float32, Float32, Float32]:
    """(intrinsics, camera_from_reference rows, its inverse's rows, photometric) as float32."""
    inverse = se3.inverse(camera_from_reference)
    return (
        _packed_camera(camera),
        np.ascontiguousarray(camera_from_reference[:3], np.float32).reshape(12),
        np.ascontiguousarray(inverse[:3], np.float32).reshape(12),
        np.array([gain, bias], np.float32),
    )


@lru_cache(maxsize=64)
def _packed_camera(camera: Camera) -> Float32:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)


@lru_cache(maxsize=64)
def _packed_model(model: ResidualModel) -> Float32:
    return np.array(
        [
            1.0 / model.colour_sigma**2, 1.0 / model.depth_sigma**2,
            model.k0_m, model.k2_per_m, model.k_slope**2,
            1.0 / model.colour_width**2, 1.0 / model.depth_width**2,
            model.colour_weight, model.depth_weight,
            model.gate**2, (model.agree / model.depth_sigma) ** 2, model.depth_step,
        ],
        np.float32,
    )  # fmt: skip
