"""The sub-map rendered through torch: gsplat on a CUDA device, for the tracker."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import GaussianTensors, RenderedView, render
from magic_core.render.backend import require_cuda


class TorchView:
    """A cloud of Gaussians as a reference view with gradients.

    backend: `cuda` (gsplat), or `reference`, the slow torch renderer that it is compared with.
    Raises NotSupported where there is no CUDA device, or no gsplat.
    """

    def __init__(
        self,
        cloud: GaussianCloud,
        camera: Camera,
        *,
        backend: Literal["cuda", "reference"] = "cuda",
    ) -> None:
        if backend == "cuda":
            require_cuda("--tracking.backend cuda", instead="--tracking.backend cpu")
        device = "cuda" if backend == "cuda" else "cpu"
        self._gaussians = GaussianTensors.from_cloud(cloud, device=device)
        self._camera, self._device = camera, device
        self._backend: Literal["cuda", "reference"] = backend
        self._last: tuple[torch.Tensor, torch.Tensor] | None = None

    def __call__(self, anchor_from_camera: NDArray[np.float64]) -> RenderedView:
        """Render the cloud, anchor frame."""
        tangent = torch.zeros(6, dtype=torch.float64, device=self._device, requires_grad=True)
        rendering = render(
            self._gaussians, self._camera, anchor_from_camera, self._backend, tangent=tangent
        )
        planes = (rendering.colour.permute(2, 0, 1), rendering.depth[None], rendering.alpha[None])
        image = torch.cat(planes)
        self._last = image, tangent
        return RenderedView(
            np.ascontiguousarray(image.detach().cpu().numpy(), np.float32),
            rendering.visible.cpu().numpy(),
            rendering.radii.detach().float().cpu().numpy(),
            0,
        )

    def backward(self, gradient: NDArray[np.float32]) -> NDArray[np.float64]:
        """(6,) gradient by the right perturbation of the last pose."""
        assert self._last is not None
        image, tangent = self._last
        weights = torch.as_tensor(gradient, dtype=image.dtype, device=image.device)
        (slope,) = torch.autograd.grad((image * weights).sum(), tangent)
        return slope.cpu().numpy().astype(np.float64)
