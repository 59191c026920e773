"""A furnished flat, rendered: agents on overlapping walks, exact poses, Kinect-like depth."""

from magic_core.data.synthetic.source import (
    SyntheticConfig,
    SyntheticSource,
    open_synthetic,
    synthetic_flat,
)

__all__ = ["SyntheticConfig", "SyntheticSource", "open_synthetic", "synthetic_flat"]
