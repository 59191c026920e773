"""The mapping losses of `losses.py` in torch, for backends that torch differentiates."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from magic_core.render.optimiser import LossWeights

_RADIUS = 5
_C1, _C2 = 0.01**2, 0.03**2


class ImageLosses(NamedTuple):
    """0-d tensors, as in `StepReport`."""

    total: Tensor
    colour_l1: Tensor
    ssim: Tensor
    depth_l1: Tensor


def image_losses(
    image: Tensor, colour: Tensor, depth: Tensor, weight: Tensor, weights: LossWeights
) -> ImageLosses:
    """Colour and depth losses of a rendered image, differentiable.

    image (5, h, w) red, green, blue, accumulated depth, alpha; colour (3, h, w) observed, 0 to 1;
    depth (h, w) metres, 0 = no reading; weight (h, w) of each pixel.
    """
    l1 = (weight * (image[:3] - colour).abs()).mean()
    similarity = weight * _ssim(image[:3], colour)
    error = weight * (image[3] - image[4] * depth).abs() * (depth > 0)
    depth_l1 = error.sum() / (depth > 0).sum().clamp(min=1)
    ssim = similarity.mean()
    by_colour = (1 - weights.ssim) * l1 + weights.ssim * (weight.mean() - ssim)
    return ImageLosses(weights.colour * by_colour + weights.depth * depth_l1, l1, ssim, depth_l1)


def scale_loss(scales: Tensor, weights: LossWeights) -> Tensor:
    """The paper's regularisation: sum |s - mean s| / n over (n, 3) scales in metres."""
    return weights.scale * (scales - scales.mean()).abs().sum() / max(len(scales), 1)


def _ssim(x: Tensor, y: Tensor) -> Tensor:
    """(3, h, w) structural similarity; Gaussian window of 11 pixels, zero padding."""
    mu_x, mu_y = _windowed(x), _windowed(y)
    covariance = _windowed(x * y) - mu_x * mu_y
    variances = _windowed(x * x) - mu_x**2 + _windowed(y * y) - mu_y**2
    means = (2 * mu_x * mu_y + _C1) / (mu_x**2 + mu_y**2 + _C1)
    return means * (2 * covariance + _C2) / (variances + _C2)


def _windowed(planes: Tensor) -> Tensor:
    """The windowed mean of each plane, down the columns and then along the rows."""
    line = _window(planes.dtype, planes.device)
    down = conv2d(planes[:, None], line.view(1, 1, -1, 1), padding=(_RADIUS, 0))
    return conv2d(down, line.view(1, 1, 1, -1), padding=(0, _RADIUS))[:, 0]


@lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    offsets = torch.arange(-_RADIUS, _RADIUS + 1, dtype=dtype, device=device)
    line = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    return line / line.sum()
