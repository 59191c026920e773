"""Compressed splat files for viewers: SPZ and SuperSplat's compressed PLY, through gsply.

About 16 bytes per Gaussian instead of 68. gsply is an extra (`pip install magic-slam[splats]`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from magic_core.errors import ConfigError
from magic_core.gaussians.cloud import GaussianCloud
from magic_core.gaussians.ply import SH_DEGREE_0

SplatFormat = Literal["spz", "compressed-ply"]
_MIN_OPACITY, _MIN_SCALE_M = 1e-6, 1e-9


def write_splats(path: Path, cloud: GaussianCloud, kind: SplatFormat) -> Path:
    """Write a cloud; ConfigError where gsply is not installed."""
    gsply = _gsply()
    opacities = np.clip(cloud.opacities.astype(np.float64), _MIN_OPACITY, 1.0 - _MIN_OPACITY)
    data = gsply.GSData(
        means=cloud.means,
        scales=np.log(np.maximum(cloud.scales, _MIN_SCALE_M)),
        quats=cloud.quaternions,
        opacities=np.log(opacities / (1.0 - opacities)).astype(np.float32),
        sh0=((cloud.colours - 0.5) / SH_DEGREE_0).astype(np.float32),
        shN=None,
    )
    partial = path.with_name(f".partial.{path.stem.removesuffix('.compressed')}{_suffix(kind)}")
    try:
        if kind == "spz":
            gsply.write_spz(partial, data)
        else:
            gsply.plywrite(partial, data, compressed=True)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _suffix(kind: SplatFormat) -> str:
    """gsply names files by their format, so the partial file must end as it wants."""
    return ".spz" if kind == "spz" else ".compressed.ply"


def _gsply() -> Any:
    try:
        import gsply
    except ImportError as error:
        raise ConfigError.field(
            "format", "compressed splats need gsply: pip install 'magic-slam[splats]'"
        ) from error
    return gsply
