"""Constants and memory layouts that the stages of the rasteriser share.

Image: planar float32 (5, h, w): red, green, blue, accumulated depth, alpha.

Tiles are 16 x 16 pixels; a tile is cut into BLOCKS blocks of 4 x BLOCK_HEIGHT pixels, one lane
per pixel. Block b covers the columns 4 (b mod 4) and on, and the rows
BLOCK_HEIGHT (b div 4) and on.

Record: 16 float32 (one cache line) per Gaussian, at index RECORD * g. Writing the 2D Gaussian as
alpha = exp(8 t), t(dx, dy) = a dx^2 + b dx dy + c dy^2 + k with (dx, dy) = pixel - centre, the
opacity is folded in as k = ln(opacity) / 8. The exponent is divided by 8 because exp(8 t) is a
short polynomial in t, squared three times.
"""

from __future__ import annotations

import math

import numpy as np

from magic_core.render.lanes import LANES
from magic_core.render.simd_memory import BLOCK_HEIGHT, BLOCK_WIDTH

f32 = np.float32

# --- what a splat is ---
NEAR_M = f32(0.01)  # Gaussians nearer than this are not drawn, metres
DILATION = f32(0.3)  # added to the 2D covariance, pixel^2 (anti-aliasing floor of 3DGS)
ALPHA_MAX = f32(0.99)
ALPHA_MIN = f32(1.0 / 255.0)  # contributions below are dropped
TRANSMITTANCE_MIN = f32(1e-4)  # a pixel is finished once less light than this passes
FRUSTUM_MARGIN = f32(0.3)  # the Jacobian is evaluated within this margin of the image (tan units)

LOG_THRESHOLD = f32(math.log(float(ALPHA_MIN)) / 8.0)  # t below this: alpha < ALPHA_MIN
MASK_SLACK = f32(1e-5)  # keeps blocks whose extreme rounds to just below the threshold

# --- tiles and blocks ---
TILE = 16
BLOCKS = TILE * TILE // LANES
BLOCKS_PER_ROW = TILE // BLOCK_WIDTH
TILE_CENTRE = f32((TILE - 1) / 2)

# --- record fields ---
RECORD = 16
U, V, A, B, C, K, RED, GREEN, BLUE, DEPTH, SHEAR_Y, SHEAR_X = range(12)
RADIUS, SLOT, SLOT_BASE, ACROSS = range(12, 16)  # the last three hold int32 bit patterns
# The gradient slots of a Gaussian's tiles are numbered row by row from SLOT on (within its chunk):
# the slot of the tile (column, row) is SLOT_BASE + row ACROSS + column.

# --- counters of one render, in RenderedView and the stage buffers ---
CHUNK_SHIFT = 10
CHUNK = 1 << CHUNK_SHIFT  # Gaussians whose visible ones are listed together

# --- the pattern of pixels in a tile, one flat table that the blend kernels read ---
BLOCK_LEFT = 0  # (BLOCKS,) left column of each block, relative to the tile's centre
BLOCK_TOP = BLOCK_LEFT + BLOCKS  # (BLOCKS,) top row
PIXELS = BLOCK_TOP + BLOCKS  # per block 5 vectors: x, y, x^2, x y, y^2
PIXEL_VECTORS = 5 * LANES


def tile_pattern() -> np.ndarray:
    """The float32 table described above."""
    block, lane = np.arange(BLOCKS), np.arange(LANES)
    left = BLOCK_WIDTH * (block % BLOCKS_PER_ROW) - TILE_CENTRE
    top = BLOCK_HEIGHT * (block // BLOCKS_PER_ROW) - TILE_CENTRE
    x = left[:, None] + lane % BLOCK_WIDTH
    y = top[:, None] + lane // BLOCK_WIDTH
    pixels = np.stack([x, y, x * x, x * y, y * y], axis=1)
    return np.concatenate([left, top, pixels.ravel()]).astype(np.float32)


def aligned_zeros(count: int, dtype: type = np.float32) -> np.ndarray:
    """A flat array of zeros that starts on a cache line.

    np.empty, not np.zeros: numpy asks for huge pages for large blocks of the former only, and the
    kernels' scattered accesses then miss the TLB far less.
    """
    size = np.dtype(dtype).itemsize
    raw = np.empty(count * size + 64, np.uint8)
    raw[:] = 0
    start = -raw.ctypes.data % 64
    return raw[start : start + count * size].view(dtype)
