"""Rendering of Gaussian clouds: CPU kernels with gradients, mapping iterations, torch API.

Names are imported when first used, so that importing the package costs neither numba nor torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from magic_core.render.api import GaussianTensors, Rendering, render
    from magic_core.render.optimiser import (
        GaussianOptimiser,
        LearningRates,
        LossWeights,
        StepReport,
    )
    from magic_core.render.rasteriser import Gradients, Rasteriser, RenderedView
    from magic_core.render.warmup import WarmUpReport, warm_up

_HOMES = {
    "GaussianTensors": "api",
    "Rendering": "api",
    "render": "api",
    "WarmUpReport": "warmup",
    "warm_up": "warmup",
    "GaussianOptimiser": "optimiser",
    "LearningRates": "optimiser",
    "LossWeights": "optimiser",
    "StepReport": "optimiser",
    "Gradients": "rasteriser",
    "Rasteriser": "rasteriser",
    "RenderedView": "rasteriser",
}

__all__ = [
    "GaussianOptimiser",
    "GaussianTensors",
    "Gradients",
    "LearningRates",
    "LossWeights",
    "Rasteriser",
    "RenderedView",
    "Rendering",
    "StepReport",
    "WarmUpReport",
    "render",
    "warm_up",
]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
