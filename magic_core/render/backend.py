"""Which optimiser a machine runs: the fused kernels, or torch with gsplat on a CUDA device."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import InvalidInput, NotSupported
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render.optimiser import GaussianOptimiser, LearningRates, LossWeights, StepReport
from magic_core.render.rasteriser import RenderedView

Device = Literal["auto", "cpu", "cuda"]


class Optimiser(Protocol):
    """A cloud under optimisation; see `GaussianOptimiser` for what each call does."""

    learning_rates: LearningRates
    weights: LossWeights

    def __len__(self) -> int: ...

    def gaussians(self) -> GaussianCloud:
        """A copy of the cloud in natural values."""
        ...

    def render(self, camera: Camera, world_from_camera: ArrayLike) -> RenderedView:
        """Render the cloud as it is."""
        ...

    def step(
        self,
        camera: Camera,
        world_from_camera: ArrayLike,
        colour: NDArray[np.uint8],
        depth: NDArray[np.float32],
        *,
        weight: NDArray[np.float32] | None = None,
    ) -> StepReport:
        """One iteration on one RGB-D image."""
        ...

    def extend(self, cloud: GaussianCloud) -> None:
        """Add Gaussians behind the present ones."""
        ...

    def prune(self, keep_mask: NDArray[np.bool_]) -> None:
        """Keep the Gaussians of a (n,) mask."""
        ...


def new_optimiser(
    gaussians: GaussianCloud,
    *,
    learning_rates: LearningRates | None = None,
    weights: LossWeights | None = None,
    threads: int | None = None,
    device: Device = "auto",
) -> Optimiser:
    """An optimiser on `device`; `auto` is cuda where a device and gsplat are, else cpu.

    `threads` counts on the CPU only. Raises NotSupported when cuda is asked for and missing.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InvalidInput.field("device", f"{device!r}: expected auto, cpu or cuda")
    if device == "cuda":
        require_cuda("device cuda", instead="the device cpu")
    if device == "cpu" or not has_cuda():
        return GaussianOptimiser(
            gaussians, learning_rates=learning_rates, weights=weights, threads=threads
        )
    from magic_core.render.torch_optimiser import TorchOptimiser

    return TorchOptimiser(gaussians, learning_rates=learning_rates, weights=weights, device="cuda")


def has_cuda() -> bool:
    """Whether gsplat is installed and torch sees a CUDA device."""
    if find_spec("gsplat") is None:
        return False
    import torch

    return torch.cuda.is_available()


def require_cuda(asked: str, *, instead: str) -> None:
    """Raise NotSupported, naming what was asked for and what to use instead, without CUDA."""
    if not has_cuda():
        raise NotSupported(
            f"{asked}: no CUDA device with gsplat here: pip install 'magic-slam[cuda]' on a CUDA "
            f"machine, or use {instead}"
        )
