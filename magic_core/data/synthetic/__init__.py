"""A furnished flat, rendered: agents on overlapping walks, exact poses, Kinect-like depth.

The sources are imported when first used: describing a recording costs neither Open3D nor numba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from magic_core.data.synthetic.config import SyntheticConfig

if TYPE_CHECKING:
    from magic_core.data.synthetic.source import SyntheticSource, open_synthetic, synthetic_flat

__all__ = ["SyntheticConfig", "SyntheticSource", "open_synthetic", "synthetic_flat"]


def __getattr__(name: str):
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from magic_core.data.synthetic import source

    return getattr(source, name)
