"""Sources of RGB-D frames: one layout per file behind one protocol."""

from magic_core.data.frame import Frame, FrameSource

__all__ = ["Frame", "FrameSource"]
