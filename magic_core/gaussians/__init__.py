"""Clouds of 3D Gaussians, PLY in and out, and the codec of the wire."""

from magic_core.gaussians.cloud import GaussianCloud

__all__ = ["GaussianCloud"]
