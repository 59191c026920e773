"""Procedural surface textures: wood, tiles, plaster, fabric and the like.

Every texture is an sRGB uint8 image that tiles seamlessly unless it is a picture (pictures.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Texture:
    """An image and how it lies on a surface."""

    image: Image  # (h, w, 3) sRGB
    size_m: float | None = None
    """Length of one repeat along the image's width; None = stretched once over its surface."""
    grain: bool = False
    """The image's horizontal axis follows a surface's longer edge, as wood grain does."""
    emission: float = 0.0
    """Radiance that the surface itself gives off, times its colour; lamps and windows."""


def noise(
    rng: np.random.Generator,
    size: tuple[int, int],
    cells: tuple[int, int],
    *,
    octaves: int = 4,
    gain: float = 0.55,
) -> NDArray[np.float32]:
    """Tileable fractal noise (h, w) of about zero mean, about unit spread."""
    height, width = size
    total = np.zeros((height, width), np.float32)
    weight, norm = 1.0, 0.0
    for octave in range(octaves):
        rows, columns = cells[0] << octave, cells[1] << octave
        if rows > height or columns > width:
            break
        grid = rng.standard_normal((rows, columns)).astype(np.float32)
        wrapped = np.pad(grid, 2, mode="wrap")
        step_y, step_x = rows / height, columns / width
        grid_from_image = np.array(
            [[step_x, 0.0, 0.5 * step_x + 1.5], [0.0, step_y, 0.5 * step_y + 1.5]]
        )
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        total += weight * cv2.warpAffine(wrapped, grid_from_image, (width, height), flags=flags)
        norm += weight**2
        weight *= gain
    return total / np.float32(np.sqrt(norm))


def to_image(values: NDArray) -> Image:
    """Round and clip to uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def plain(colour: Rgb, *, emission: float = 0.0) -> Texture:
    """One colour."""
    return Texture(np.full((4, 4, 3), colour, np.uint8), 1.0, emission=emission)


def plaster(rng: np.random.Generator, colour: Rgb, *, strength: float = 5.0) -> Texture:
    """A painted wall: broad mottling, roller grain, a few scuffs."""
    size = (512, 512)
    mottle = noise(rng, size, (3, 3), octaves=3)
    grain = noise(rng, size, (64, 64), octaves=3, gain=0.8)
    value = strength * mottle + 0.8 * strength * grain
    return Texture(to_image(np.asarray(colour, np.float32) + value[..., None]), 2.2)


def wallpaper(rng: np.random.Generator, ground: Rgb, figure: Rgb, accent: Rgb) -> Texture:
    """Rows of leaf sprigs, offset from row to row."""
    image = plaster(rng, ground, strength=3.0).image.copy()
    for row in range(4):
        for column in range(4):
            x = 128 * column + 64 * (row % 2) + 32
            y = 128 * row + 64
            for dx in (-512, 0, 512):
                _sprig(image, (x + dx, y), figure, accent)
    return Texture(image, 1.3)


def _sprig(image: Image, centre: tuple[int, int], figure: Rgb, accent: Rgb) -> None:
    x, y = centre
    cv2.line(image, (x, y + 42), (x, y - 30), figure, 3, cv2.LINE_AA)
    for level in range(4):
        for side in (-1, 1):
            tip = (x + side * (24 - 3 * level), y + 26 - 18 * level)
            angle = -side * 35.0
            cv2.ellipse(image, (int((x + tip[0]) / 2), tip[1]), (13, 5), angle, 0, 360, figure, -1, cv2.LINE_AA)  # fmt: skip  # noqa: E501
    cv2.circle(image, (x, y - 36), 8, accent, -1, cv2.LINE_AA)


def wood(rng: np.random.Generator, colour: Rgb, *, contrast: float = 1.0) -> Texture:
    """Straight-grained boards for furniture."""
    return Texture(to_image(_grain(rng, (256, 512), colour, contrast)), 0.9, grain=True)


def _grain(
    rng: np.random.Generator, size: tuple[int, int], colour: Rgb, contrast: float
) -> NDArray[np.float32]:
    long = noise(rng, size, (8, 1), octaves=4, gain=0.7)
    fibre = noise(rng, size, (64, 2), octaves=3, gain=0.8)
    rings = np.sin(7.0 * noise(rng, size, (3, 1), octaves=2))
    value = contrast * (0.05 * long + 0.045 * fibre + 0.05 * rings)
    return (np.asarray(colour, np.float32) * (1.0 + value[..., None])).astype(np.float32)


def planks(rng: np.random.Generator, colour: Rgb, *, rows: int = 8) -> Texture:
    """A plank floor: boards of different tone, staggered joints, dark gaps."""
    height, width = 1024, 1024
    board = height // rows
    image = np.zeros((height, width, 3), np.float32)
    for row in range(rows):
        joints = np.sort((rng.uniform(0.15, 0.35) + np.array([0.0, 0.5])) % 1.0) * width
        strip = _grain(rng, (board, width), colour, 1.6)
        tone = 1.0 + 0.10 * rng.standard_normal(2)
        x = np.arange(width)
        first = (x >= joints[0]) & (x < joints[1])
        strip *= np.where(first, tone[0], tone[1])[None, :, None].astype(np.float32)
        strip[:3] *= 0.55
        for joint in joints:
            strip[:, int(joint) : int(joint) + 3] *= 0.55
        image[row * board : (row + 1) * board] = strip
    return Texture(to_image(image), 1.3)


def herringbone(rng: np.random.Generator, colour: Rgb) -> Texture:
    """Parquet laid in a herringbone: blocks of 1 x 4 units, a cell repeats after 8 x 8 units."""
    unit, length = 64, 4
    size = unit * 2 * length
    image = np.zeros((size, size, 3), np.float32)
    for diagonal in range(2 * length):
        for step in range(2):
            tone = 1.0 + 0.11 * rng.standard_normal()
            block = _grain(rng, (unit, unit * length), colour, 1.4) * np.float32(tone)
            block[:2], block[:, :2] = block[:2] * 0.6, block[:, :2] * 0.6
            origin = diagonal + length * step
            _paste(image, block, row=diagonal * unit, column=origin * unit)
            upright = np.swapaxes(block[:, ::-1], 0, 1) * np.float32(1 + 0.05 * rng.normal())
            if step == 0:
                _paste(image, upright, row=(diagonal + 1) * unit, column=diagonal * unit)
                _paste(image, upright, row=(diagonal + 1 + length) * unit,
                       column=(diagonal + length) * unit)  # fmt: skip
    return Texture(to_image(image), 1.2)


def _paste(image: NDArray, block: NDArray, *, row: int, column: int) -> None:
    """Write a block, wrapping round the borders."""
    rows = (row + np.arange(block.shape[0])) % image.shape[0]
    columns = (column + np.arange(block.shape[1])) % image.shape[1]
    image[np.ix_(rows, columns)] = block


def tiles(
    rng: np.random.Generator,
    colours: Sequence[Rgb],
    *,
    count: int = 4,
    size_m: float = 1.2,
    grout: Rgb = (150, 148, 144),
) -> Texture:
    """Square tiles of alternating colours with grout and a little marbling."""
    size = 512
    tile = size // count
    image = np.empty((size, size, 3), np.float32)
    veins = noise(rng, (size, size), (5, 5), octaves=5, gain=0.75)
    for row in range(count):
        for column in range(count):
            colour = np.asarray(colours[(row + column) % len(colours)], np.float32)
            part = np.s_[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile]
            shift = 6.0 * rng.standard_normal()
            image[part] = colour + shift + 9.0 * veins[part][..., None]
    for line in range(count):
        image[line * tile : line * tile + 4] = grout
        image[:, line * tile : line * tile + 4] = grout
    return Texture(to_image(image), size_m)


def bricks(rng: np.random.Generator, colour: Rgb, mortar: Rgb) -> Texture:
    """Running-bond brickwork."""
    height, width, rows, columns = 512, 512, 12, 4
    image = np.empty((height, width, 3), np.float32)
    image[:] = mortar
    rough = noise(rng, (height, width), (24, 24), octaves=4, gain=0.8)
    for row in range(rows):
        y0, y1 = row * height // rows + 3, (row + 1) * height // rows - 2
        for column in range(columns):
            tone = 1.0 + 0.13 * rng.standard_normal()
            brick = np.empty((y1 - y0, width // columns - 5, 3), np.float32)
            brick[:] = np.asarray(colour, np.float32) * tone
            x0 = column * width // columns + (width // columns // 2) * (row % 2) + 3
            _paste(image, brick, row=y0, column=x0)
    return Texture(to_image(image + 9.0 * rough[..., None]), 1.0)


def fabric(rng: np.random.Generator, colour: Rgb, *, weave: float = 7.0) -> Texture:
    """A coarse weave with broad wear."""
    size = (512, 512)
    y, x = np.mgrid[0:512, 0:512].astype(np.float32)
    threads = np.sin(x * (2 * np.pi / 8)) * np.sin(y * (2 * np.pi / 8))
    speckle = noise(rng, size, (96, 96), octaves=3, gain=0.9)
    wear = noise(rng, size, (4, 4), octaves=3)
    value = weave * (0.5 * threads + 1.1 * speckle + 0.7 * wear)
    return Texture(to_image(np.asarray(colour, np.float32) + value[..., None]), 0.6)


def stripes(rng: np.random.Generator, colours: Sequence[Rgb], *, size_m: float = 0.5) -> Texture:
    """Woven stripes of uneven width."""
    image = np.empty((256, 256, 3), np.float32)
    edges = np.cumsum(rng.uniform(0.6, 1.6, 2 * len(colours)))
    edges = (256 * edges / edges[-1]).astype(int)
    start = 0
    for number, end in enumerate(edges):
        image[:, start:end] = colours[number % len(colours)]
        start = end
    speckle = noise(rng, (256, 256), (64, 64), octaves=3, gain=0.9)
    return Texture(to_image(image + 7.0 * speckle[..., None]), size_m)


def stone(rng: np.random.Generator, colour: Rgb) -> Texture:
    """Speckled worktop stone."""
    size = (512, 512)
    speckle = noise(rng, size, (80, 80), octaves=3, gain=1.0)
    veins = np.abs(noise(rng, size, (4, 4), octaves=5, gain=0.65))
    value = 15.0 * speckle - 26.0 * np.exp(-((veins / 0.08) ** 2))
    return Texture(to_image(np.asarray(colour, np.float32) + value[..., None]), 0.8)


def lattice(rng: np.random.Generator, ground: Rgb, figure: Rgb, *, size_m: float) -> Texture:
    """A knotted carpet of diamonds within diamonds."""
    y, x = np.mgrid[0:256, 0:256].astype(np.float32) / 128.0 - 1.0
    distance = np.abs(x) + np.abs(y)
    bands = ((distance % 1.0) * 6.0).astype(int)
    weight = np.isin(bands, (0, 2, 5)).astype(np.float32)[..., None]
    image = weight * np.asarray(figure, np.float32) + (1 - weight) * np.asarray(ground, np.float32)
    speckle = noise(rng, (256, 256), (64, 64), octaves=3, gain=0.9)
    return Texture(to_image(image + 8.0 * speckle[..., None]), size_m)
