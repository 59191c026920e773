"""Rigid transforms, cameras and trajectory alignment. Conventions: docs/conventions.md."""

from magic_core.geometry import se3
from magic_core.geometry.camera import Camera

__all__ = ["Camera", "se3"]
