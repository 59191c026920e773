"""How well the map under refinement shows its keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magic_core.render.backend import Optimiser
from magic_server.globalmap.placement import View


def mean_psnr(optimiser: Optimiser, views: Sequence[View]) -> float:
    """Mean PSNR in dB of the rendered against the real colours, whole images; NaN without views."""
    if not views or len(optimiser) == 0:
        return float("nan")
    return float(np.mean([_psnr(optimiser, view) for view in views]))


def _psnr(optimiser: Optimiser, view: View) -> float:
    rendered = optimiser.render(view.camera, view.world_from_camera).colour
    error = np.clip(rendered, 0.0, 1.0) - view.colour.astype(np.float32) / 255.0
    return float(-10.0 * np.log10(max(float(np.mean(error**2)), 1e-10)))
