"""Mapping iterations on a torch device: what `GaussianOptimiser` does, through autograd.

On a CUDA device gsplat renders; on the CPU the kernels do, which is how the tests hold this class
against the fused one.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render.adam import LOG_SCALE_MAX, LOG_SCALE_MIN, LOGIT_LIMIT
from magic_core.render.api import GaussianTensors, Rendering, render
from magic_core.render.optimiser import LearningRates, LossWeights, StepReport, check_images
from magic_core.render.rasteriser import Float32, RenderedView
from magic_core.render.torch_losses import image_losses, scale_loss

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15
_MEANS, _QUATERNIONS, _LOG_SCALES, _LOGITS, _COLOURS = range(5)


class TorchOptimiser:
    """A cloud under optimisation on a torch device; the same calls as `GaussianOptimiser`."""

    def __init__(
        self,
        gaussians: GaussianCloud,
        *,
        learning_rates: LearningRates | None = None,
        weights: LossWeights | None = None,
        device: str = "cuda",
    ) -> None:
        self.learning_rates = learning_rates or LearningRates()
        self.weights = weights or LossWeights()
        self._device = device
        self._parameters = self._of(GaussianCloud.empty())
        self._moments = [torch.zeros_like(p) for p in self._parameters]
        self._squares = [torch.zeros_like(p) for p in self._parameters]
        self._steps = torch.zeros(0, device=device)
        self.extend(gaussians)

    def __len__(self) -> int:
        return len(self._steps)

    def gaussians(self) -> GaussianCloud:
        """A copy of the cloud in natural values."""
        means, quaternions, scales, opacities, colours = (
            t.detach().cpu().numpy() for t in self._natural().tensors()
        )
        return GaussianCloud.from_arrays(
            means, quaternions, scales=scales, opacities=opacities, colours=colours
        )

    @torch.no_grad()
    def render(self, camera: Camera, world_from_camera: ArrayLike) -> RenderedView:
        """Render the cloud as it is."""
        out = render(self._natural(), camera, np.asarray(world_from_camera, np.float64))
        return RenderedView(
            image=np.ascontiguousarray(_image(out).cpu().numpy(), np.float32),
            visible=out.visible.cpu().numpy(),
            radii=out.radii.cpu().numpy(),
            culled_not_finite=0,  # what is not finite cannot get in: `extend` drops it
        )

    def step(
        self,
        camera: Camera,
        world_from_camera: ArrayLike,
        colour: NDArray[np.uint8],
        depth: Float32,
        *,
        weight: Float32 | None = None,
    ) -> StepReport:
        """One iteration on one RGB-D image; arguments as in `GaussianOptimiser.step`."""
        check_images(camera, colour, depth, weight)
        for parameter in self._parameters:
            parameter.requires_grad_()
        natural = self._natural()
        out = render(natural, camera, np.asarray(world_from_camera, np.float64))
        found = image_losses(
            _image(out), self._tensor(colour).permute(2, 0, 1) / 255.0, self._tensor(depth),
            torch.ones(depth.shape, device=self._device) if weight is None
            else self._tensor(weight),
            self.weights,
        )  # fmt: skip
        loss = found.total + scale_loss(natural.scales, self.weights)
        gradients = torch.autograd.grad(loss, self._parameters)
        for parameter in self._parameters:
            parameter.requires_grad_(False)
        self._adam(gradients, out.radii > 0)
        return StepReport(
            float(loss.detach()), *(float(v.detach()) for v in found[1:])
        )  # fmt: skip

    def extend(self, cloud: GaussianCloud) -> None:
        """Add Gaussians, with fresh moments, behind the present ones; drops what is not finite."""
        finite = np.asarray(np.isfinite(np.column_stack(cloud.arrays())).all(axis=1))
        new = self._of(cloud.select(finite))
        self._parameters = [torch.cat(pair) for pair in zip(self._parameters, new, strict=True)]
        for moments in (self._moments, self._squares):
            moments[:] = [
                torch.cat([old, torch.zeros_like(p)]) for old, p in zip(moments, new, strict=True)
            ]
        self._steps = torch.cat([self._steps, torch.zeros(len(new[0]), device=self._device)])

    def prune(self, keep_mask: NDArray[np.bool_]) -> None:
        """Keep the Gaussians of a (n,) mask, with their moments, in their order."""
        if keep_mask.shape != (len(self),):
            text = f"shape {keep_mask.shape}, expected ({len(self)},)"
            raise InvalidInput.field("keep_mask", text)
        mask = torch.as_tensor(keep_mask, device=self._device)
        for tensors in (self._parameters, self._moments, self._squares):
            tensors[:] = [t[mask] for t in tensors]
        self._steps = self._steps[mask]

    def _of(self, cloud: GaussianCloud) -> list[Tensor]:
        """The optimiser's parameters of a cloud: scales by logarithm, opacities by logit."""
        means, quaternions, scales, opacities, colours = (self._tensor(a) for a in cloud.arrays())
        opacities = opacities.clamp(1e-6, 1 - 1e-6)
        return [means, quaternions, scales.clamp(min=1e-6).log(), opacities.logit(), colours]

    def _tensor(self, array: NDArray) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=self._device)

    def _natural(self) -> GaussianTensors:
        means, quaternions, log_scales, logits, colours = self._parameters
        return GaussianTensors(means, quaternions, log_scales.exp(), logits.sigmoid(), colours)

    @torch.no_grad()
    def _adam(self, gradients: tuple[Tensor, ...], drawn: Tensor) -> None:
        """One step of what was drawn; the rest keeps its values, moments and step counts."""
        rates = self.learning_rates
        self._steps += drawn
        t = self._steps.clamp(min=1)
        correction1, correction2 = 1 - _BETA1**t, 1 - _BETA2**t
        each = (rates.means, rates.quaternions, rates.scales, rates.opacities, rates.colours)
        for k, (rate, gradient) in enumerate(zip(each, gradients, strict=True)):
            parameter, m, v = self._parameters[k], self._moments[k], self._squares[k]
            column = (-1, *[1] * (gradient.ndim - 1))
            mask = drawn.view(column)
            m.copy_(torch.where(mask, torch.lerp(gradient, m, _BETA1), m))
            v.copy_(torch.where(mask, torch.lerp(gradient**2, v, _BETA2), v))
            size = (v / correction2.view(column)).sqrt() + _EPSILON
            move = rate * m / correction1.view(column) / size
            parameter.sub_(torch.where(mask, move, torch.zeros_like(move)))
        self._keep_in_range()

    def _keep_in_range(self) -> None:
        quaternions = self._parameters[_QUATERNIONS]
        quaternions.div_(quaternions.norm(dim=1, keepdim=True))
        self._parameters[_LOG_SCALES].clamp_(float(LOG_SCALE_MIN), float(LOG_SCALE_MAX))
        self._parameters[_LOGITS].clamp_(-float(LOGIT_LIMIT), float(LOGIT_LIMIT))
        self._parameters[_COLOURS].clamp_(0.0, 1.0)


def _image(out: Rendering) -> Tensor:
    """(5, h, w) red, green, blue, accumulated depth, alpha."""
    return torch.cat([out.colour.permute(2, 0, 1), out.depth[None], out.alpha[None]])
