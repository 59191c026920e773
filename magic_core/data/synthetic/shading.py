"""The kernel that turns hit triangles into colours: texture, baked light, tone curve, sRGB."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_WHITE = 3.5  # relative radiance that the tone curve maps to white
_FACING_ENOUGH = 0.6  # cosine above which one mip-mapped sample is as good as four


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _hit(d, o, e1, e2):
    """(b, g, z, facing): barycentric weights of the second and third corner where a ray meets a
    triangle's plane, the distance along the ray, and the cosine to the normal.

    Moeller and Trumbore (1997), without their test for being inside: a sample half a pixel beyond
    the triangle continues its plane.
    """
    hx = d[1] * e2[2] - d[2] * e2[1]
    hy = d[2] * e2[0] - d[0] * e2[2]
    hz = d[0] * e2[1] - d[1] * e2[0]
    scale = 1.0 / (e1[0] * hx + e1[1] * hy + e1[2] * hz + 1e-20)
    qx = o[1] * e1[2] - o[2] * e1[1]
    qy = o[2] * e1[0] - o[0] * e1[2]
    qz = o[0] * e1[1] - o[1] * e1[0]
    b = min(max(scale * (o[0] * hx + o[1] * hy + o[2] * hz), -0.5), 1.5)
    g = min(max(scale * (d[0] * qx + d[1] * qy + d[2] * qz), -0.5), 1.5)
    z = max(scale * (e2[0] * qx + e2[1] * qy + e2[2] * qz), 0.0)
    nx = e1[1] * e2[2] - e1[2] * e2[1]
    ny = e1[2] * e2[0] - e1[0] * e2[2]
    nz = e1[0] * e2[1] - e1[1] * e2[0]
    lengths = (nx * nx + ny * ny + nz * nz) * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    facing = abs(nx * d[0] + ny * d[1] + nz * d[2]) / math.sqrt(lengths + 1e-20)
    return b, g, z, facing


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _fetch(texels, linear, level, u, v, out):
    """Bilinear, wrapping lookup of linear colour in one mip level (start, height, width)."""
    start, height, width = level
    x = (u - math.floor(u)) * width - 0.5
    y = (v - math.floor(v)) * height - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    ax, ay = x - x0, y - y0
    xa, ya = int(x0), int(y0)
    xa = xa + width if xa < 0 else xa
    ya = ya + height if ya < 0 else ya
    xb = xa + 1 if xa + 1 < width else 0
    yb = ya + 1 if ya + 1 < height else 0
    for c in range(3):
        top = (1 - ax) * linear[texels[start + ya * width + xa, c]]
        top += ax * linear[texels[start + ya * width + xb, c]]
        low = (1 - ax) * linear[texels[start + yb * width + xa, c]]
        low += ax * linear[texels[start + yb * width + xb, c]]
        out[c] = (1 - ay) * top + ay * low


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _encoded(value):
    """sRGB byte of linear light."""
    value = min(value, 1.0)
    encoded = 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055
    return int(255.0 * encoded + 0.5)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def shade(
    samples, border, cosine, subpixels, intrinsics, pose, vertices, triangles, texture_uv, light,
    triangle_patch, patch_texture, texels_per_m, glow, texels, levels, linear, exposure, colour,
):  # fmt: skip
    """Write the (h, w, 3) colour of the triangles (h, w, 4) that the pixels' samples hit.

    Pixels on a border, or whose surface is seen at an angle, average their four samples; the
    others take one at their centre. Tone curve after Reinhard et al. (2002), applied per sample
    so that bright lamps do not bleed over antialiased edges.
    """
    fx, fy, cx, cy = intrinsics
    height, width, count = samples.shape
    fine, coarse = np.zeros(3, np.float32), np.zeros(3, np.float32)
    d, total = np.zeros(3, np.float32), np.zeros(3, np.float32)
    e1, e2, o = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
    for row in range(height):
        for column in range(width):
            total[:] = 0.0
            taken, spread, footprint = count, 1.0, 0.5
            if not border[row, column] and cosine[row, column] > _FACING_ENOUGH:
                taken, spread, footprint = 1, 0.0, 1.0
            for k in range(taken):
                triangle = samples[row, column, k]
                if triangle < 0:
                    continue
                x = (column + spread * subpixels[k, 0] - cx) / fx
                y = (row + spread * subpixels[k, 1] - cy) / fy
                i0, i1, i2 = triangles[triangle]
                for c in range(3):
                    d[c] = pose[c, 0] * x + pose[c, 1] * y + pose[c, 2]
                    e1[c] = vertices[i1, c] - vertices[i0, c]
                    e2[c] = vertices[i2, c] - vertices[i0, c]
                    o[c] = pose[c, 3] - vertices[i0, c]
                b, g, z, facing = _hit(d, o, e1, e2)
                a = 1.0 - b - g
                u = a * texture_uv[i0, 0] + b * texture_uv[i1, 0] + g * texture_uv[i2, 0]
                v = a * texture_uv[i0, 1] + b * texture_uv[i1, 1] + g * texture_uv[i2, 1]
                patch = triangle_patch[triangle]
                texel = footprint * z / fx * texels_per_m[patch] / math.sqrt(max(facing, 0.05))
                level = min(max(math.log2(max(texel, 1e-6)), 0.0), levels.shape[1] - 1.001)
                low = int(level)
                blend = level - low
                _fetch(texels, linear, levels[patch_texture[patch], low], u, v, fine)
                _fetch(texels, linear, levels[patch_texture[patch], low + 1], u, v, coarse)
                for c in range(3):
                    albedo = (1 - blend) * fine[c] + blend * coarse[c]
                    lit = a * light[i0, c] + b * light[i1, c] + g * light[i2, c]
                    radiance = albedo * (exposure * max(lit, 0.0) + glow[patch])
                    total[c] += radiance * (1 + radiance / (_WHITE * _WHITE)) / (1 + radiance)
            for c in range(3):
                colour[row, column, c] = _encoded(total[c] / taken)
