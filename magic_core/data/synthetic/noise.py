"""Depth as a Kinect-like sensor would report it.

Axial noise after Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D
Reconstruction and Tracking" (3DIMPVT 2012); disparity in steps of 1/8 pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_FOCAL_BASELINE = 580.0 * 0.075  # pixel metres of the first Kinect
_DISPARITY_STEP = 0.125  # pixels
_MIN_DEPTH_M, _MAX_DEPTH_M = 0.35, 8.0
_EDGE = 0.04  # share of the depth that counts as a step between two surfaces
_EDGE_LOSS = 0.55  # how often a pixel beside a step has no reading
_GRAZING_COSINE = 0.12


def kinect_depth(
    depth: NDArray[np.float32], cosine: NDArray[np.float32], *, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Noisy (h, w) depth in metres of exact depth; 0 = no reading.

    Noise grows with the square of the distance, depth is quantised in disparity, readings vanish
    beside depth steps, on grazing surfaces and out of range.
    """
    sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    fine = rng.standard_normal(depth.shape).astype(np.float32)
    broad = np.asarray(cv2.GaussianBlur(fine, (0, 0), 1.2), np.float32)
    broad /= max(float(broad.std()), 1e-6)  # neighbouring pixels share the matching window
    noisy = depth + sigma * (0.5 * fine + 0.8 * broad)
    disparity = _FOCAL_BASELINE / np.maximum(noisy, 0.1)
    steps = np.maximum(np.rint(disparity / _DISPARITY_STEP), 1.0)
    measured = (_FOCAL_BASELINE / (steps * _DISPARITY_STEP)).astype(np.float32)
    lost = _beside_step(depth) & (rng.random(depth.shape) < _EDGE_LOSS)
    lost |= (cosine < _GRAZING_COSINE) | (depth < _MIN_DEPTH_M) | (depth > _MAX_DEPTH_M)
    return np.where(lost, np.float32(0), measured)


def _beside_step(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    kernel = np.ones((3, 3), np.uint8)
    return (cv2.dilate(depth, kernel) - cv2.erode(depth, kernel)) > _EDGE * np.maximum(depth, 0.1)
