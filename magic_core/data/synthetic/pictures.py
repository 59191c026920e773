"""Procedural pictures that are stretched once over their surface: paintings, books, screens."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

from magic_core.data.synthetic.textures import Image, Rgb, Texture, noise, to_image

_PALETTES: tuple[tuple[Rgb, ...], ...] = (
    ((233, 196, 106), (231, 111, 81), (42, 157, 143), (38, 70, 83), (244, 241, 222)),
    ((29, 53, 87), (69, 123, 157), (168, 218, 220), (241, 250, 238), (230, 57, 70)),
    ((61, 64, 91), (224, 122, 95), (129, 178, 154), (242, 204, 143), (244, 241, 222)),
    ((53, 80, 112), (109, 89, 122), (181, 101, 118), (229, 107, 111), (234, 172, 139)),
    ((20, 33, 61), (252, 163, 17), (229, 229, 229), (0, 95, 115), (148, 210, 189)),
)


def painting(
    rng: np.random.Generator, style: int, *, size: tuple[int, int] = (384, 384)
) -> Texture:
    """An abstract painting; `style` counts round through the six kinds."""
    kinds = (_landscape, _circles, _blocks, _leaves, _waves, _triangles)
    palette = _PALETTES[int(rng.integers(len(_PALETTES)))]
    image = kinds[style % len(kinds)](rng, size, palette)
    canvas = noise(rng, size, (96, 96), octaves=2, gain=0.9)
    return Texture(to_image(image.astype(np.float32) + 4.0 * canvas[..., None]))


def _blank(size: tuple[int, int], colour: Rgb) -> Image:
    return np.full((*size, 3), colour, np.uint8)


def _landscape(rng: np.random.Generator, size: tuple[int, int], palette: tuple[Rgb, ...]) -> Image:
    height, width = size
    blend = np.linspace(0, 1, height)[:, None, None]
    top, low = np.asarray(palette[1], np.float32), np.asarray(palette[4], np.float32)
    image = to_image(np.broadcast_to((1 - blend) * top + blend * low, (height, width, 3)))
    sun = (int(rng.uniform(0.2, 0.8) * width), int(0.28 * height))
    cv2.circle(image, sun, width // 9, palette[0], -1, cv2.LINE_AA)
    x = np.linspace(0, 1, width)
    for layer in range(5):
        base = 0.42 + 0.12 * layer
        phase, frequency = rng.uniform(0, 6.28), rng.uniform(1.0, 3.5)
        ridge = base + 0.06 * np.sin(2 * np.pi * frequency * x + phase)
        ridge += 0.025 * np.sin(2 * np.pi * 3.1 * frequency * x + 2 * phase)
        shade = np.asarray(palette[(layer + 2) % 4], np.float32) * (1.0 - 0.12 * layer)
        outline = [(int(a * width), int(b * height)) for a, b in zip(x, ridge, strict=True)]
        polygon = np.array([*outline, (width, height), (0, height)], np.int32)
        cv2.fillPoly(image, [polygon], to_image(shade).tolist(), cv2.LINE_AA)
    return image


def _circles(rng: np.random.Generator, size: tuple[int, int], palette: tuple[Rgb, ...]) -> Image:
    image = _blank(size, palette[-1])
    for _ in range(16):
        centre = (int(rng.integers(size[1])), int(rng.integers(size[0])))
        radius = int(rng.uniform(0.04, 0.2) * size[0])
        for ring, share in enumerate((1.0, 0.72, 0.45, 0.2)):
            colour = palette[int(rng.integers(len(palette)))] if ring else palette[3]
            cv2.circle(image, centre, max(2, int(radius * share)), colour, -1, cv2.LINE_AA)
    return image


def _blocks(rng: np.random.Generator, size: tuple[int, int], palette: tuple[Rgb, ...]) -> Image:
    image = _blank(size, (240, 236, 226))
    columns = np.sort(rng.uniform(0, size[1], 5)).astype(int)
    rows = np.sort(rng.uniform(0, size[0], 5)).astype(int)
    for x0, x1 in zip([0, *columns], [*columns, size[1]], strict=True):
        for y0, y1 in zip([0, *rows], [*rows, size[0]], strict=True):
            if rng.uniform() < 0.45:
                image[y0:y1, x0:x1] = palette[int(rng.integers(len(palette)))]
    for x in columns:
        cv2.line(image, (int(x), 0), (int(x), size[0]), (24, 24, 28), 8)
    for y in rows:
        cv2.line(image, (0, int(y)), (size[1], int(y)), (24, 24, 28), 8)
    return image


def _leaves(rng: np.random.Generator, size: tuple[int, int], palette: tuple[Rgb, ...]) -> Image:
    image = _blank(size, (246, 240, 228))
    for _ in range(26):
        centre = (int(rng.integers(size[1])), int(rng.integers(size[0])))
        axes = (int(rng.uniform(28, 62)), int(rng.uniform(8, 20)))
        angle = float(rng.uniform(0, 180))
        colour = palette[int(rng.integers(len(palette) - 1))]
        cv2.ellipse(image, centre, axes, angle, 0, 360, colour, -1, cv2.LINE_AA)
        direction = np.deg2rad(angle)
        tip = np.array([np.cos(direction), np.sin(direction)]) * axes[0]
        start, end = np.array(centre) - tip, np.array(centre) + tip
        cv2.line(image, tuple(start.astype(int).tolist()), tuple(end.astype(int).tolist()),
                 (250, 246, 236), 2, cv2.LINE_AA)  # fmt: skip
    return image


def _waves(rng: np.random.Generator, size: tuple[int, int], palette: tuple[Rgb, ...]) -> Image:
    y, x = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32) / size[0]
    bend = 0.6 * noise(rng, size, (2, 2), octaves=2)
    index = np.floor((y + 0.25 * np.sin(5.0 * x + 2.0 * bend) + 0.2 * bend) * 9.0).astype(int)
    return np.asarray(palette, np.uint8)[index % len(palette)]


def _triangles(rng: np.random.Generator, size: tuple[int, int], palette: tuple[Rgb, ...]) -> Image:
    image = _blank(size, palette[-1])
    count = 6
    step_y, step_x = size[0] / count, size[1] / count
    for row in range(count):
        for column in range(count):
            x, y = column * step_x, row * step_y
            corners = np.array([(x, y), (x + step_x, y), (x + step_x, y + step_y), (x, y + step_y)])
            keep = np.roll(corners, int(rng.integers(4)), axis=0)[:3].astype(np.int32)
            colour = palette[int(rng.integers(len(palette)))]
            cv2.fillPoly(image, [keep], colour, cv2.LINE_AA)
    return image


def book_row(rng: np.random.Generator, *, width: int = 512, height: int = 160) -> Texture:
    """The spines of a shelf of books."""
    image = _blank((height, width), (38, 30, 26))
    x = 0
    while x < width:
        thickness = int(rng.uniform(10, 26))
        tall = int(rng.uniform(0.68, 0.98) * height)
        hue, saturation, value = rng.uniform(), rng.uniform(0.25, 0.8), rng.uniform(0.35, 0.95)
        colour = tuple(int(255 * c) for c in colorsys.hsv_to_rgb(hue, saturation, value))
        cv2.rectangle(image, (x, height - tall), (x + thickness - 2, height), colour, -1)
        band = tuple(int(min(255, 40 + 1.1 * c)) for c in colour[::-1])
        for position in (0.15, 0.8):
            y = height - int(tall * position)
            cv2.rectangle(image, (x, y), (x + thickness - 2, y + 5), band, -1)
        y0, y1 = height - int(0.68 * tall), height - int(0.32 * tall)
        for y in range(y0, y1, 7):
            reach = int(rng.uniform(0.3, 0.8) * thickness)
            cv2.line(image, (x + 4, y), (x + reach, y), band, 2)
        x += thickness
    return Texture(image)


def sky(rng: np.random.Generator, *, emission: float) -> Texture:
    """The view out of a window: sky, clouds, a line of trees."""
    size = (384, 384)
    blend = np.linspace(0, 1, size[0])[:, None, None] ** 0.8
    blue, haze = np.array((138, 184, 232), np.float32), np.array((232, 238, 240), np.float32)
    image = np.broadcast_to((1 - blend) * blue + blend * haze, (*size, 3)).copy()
    clouds = np.clip(noise(rng, size, (4, 2), octaves=5) - 0.2, 0, 1)[..., None]
    image = image + clouds * (np.array((252, 252, 252), np.float32) - image)
    crowns = 0.72 + 0.06 * noise(rng, (1, size[1]), (1, 6), octaves=4)[0]
    y = np.linspace(0, 1, size[0])[:, None]
    foliage = noise(rng, size, (24, 24), octaves=4, gain=0.8)[..., None]
    green = np.array((112, 146, 96), np.float32) * (1.0 + 0.16 * foliage)
    return Texture(to_image(np.where((y > crowns)[..., None], green, image)), emission=emission)


def screen(rng: np.random.Generator) -> Texture:
    """A monitor with windows full of text-like lines."""
    image = _blank((288, 512), (24, 28, 36))
    accents = ((86, 182, 194), (152, 195, 121), (224, 108, 117), (229, 192, 123), (171, 178, 191))
    for x0, x1 in ((14, 330), (346, 498)):
        cv2.rectangle(image, (x0, 14), (x1, 274), (33, 38, 48), -1)
        cv2.rectangle(image, (x0, 14), (x1, 28), (58, 66, 82), -1)
        for y in range(40, 268, 10):
            x = x0 + 10 + 14 * int(rng.integers(0, 4))
            while x < x1 - 40 and rng.uniform() < 0.8:
                length = int(rng.uniform(14, 60))
                end = min(x + length, x1 - 10)
                cv2.line(image, (x, y), (end, y), accents[int(rng.integers(5))], 3)
                x = end + 8
    return Texture(image, emission=0.25)


def clock() -> Texture:
    """A wall clock at ten past ten."""
    image = _blank((256, 256), (245, 243, 236))
    cv2.circle(image, (128, 128), 122, (40, 44, 52), 10, cv2.LINE_AA)
    for hour in range(12):
        direction = np.array([np.sin(hour * np.pi / 6), -np.cos(hour * np.pi / 6)])
        inner, outer = 128 + 88 * direction, 128 + 106 * direction
        cv2.line(image, tuple(inner.astype(int).tolist()), tuple(outer.astype(int).tolist()),
                 (40, 44, 52), 6, cv2.LINE_AA)  # fmt: skip
    cv2.line(image, (128, 128), (84, 96), (40, 44, 52), 9, cv2.LINE_AA)
    cv2.line(image, (128, 128), (190, 84), (200, 70, 50), 6, cv2.LINE_AA)
    return Texture(image)


def poster(rng: np.random.Generator, title: str, subtitle: str) -> Texture:
    """A printed poster with a title."""
    art = painting(rng, int(rng.integers(6)), size=(300, 320)).image
    image = _blank((480, 360), (246, 242, 233))
    image[24:324, 20:340] = art
    cv2.putText(
        image, title, (20, 392), cv2.FONT_HERSHEY_SIMPLEX, 1.5, (34, 38, 46), 4, cv2.LINE_AA
    )
    cv2.putText(
        image, subtitle, (22, 440), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (150, 70, 50), 2, cv2.LINE_AA
    )
    return Texture(image)


def drawers(wood: Texture, *, rows: int, columns: int, knob: Rgb = (60, 58, 56)) -> Texture:
    """Cabinet fronts: shadow gaps and knobs drawn on a wood or painted ground."""
    image = cv2.resize(wood.image, (128 * columns, 128 * rows)).astype(np.float32)
    for row in range(rows):
        for column in range(columns):
            x, y = 128 * column, 128 * row
            cv2.rectangle(image, (x + 2, y + 2), (x + 125, y + 125), (46, 42, 40), 3)
            cv2.rectangle(image, (x + 14, y + 14), (x + 113, y + 113), (120, 110, 100), 1)
            cv2.line(image, (x + 44, y + 26), (x + 84, y + 26), knob, 6)
    return Texture(to_image(image))


def rug(rng: np.random.Generator, palette_index: int) -> Texture:
    """A carpet with borders and a medallion field."""
    palette = _PALETTES[palette_index % len(_PALETTES)]
    height, width = 384, 576
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    edge = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y))
    u, v = (x - width / 2) / (height / 2), (y - height / 2) / (height / 2)
    radius = np.abs(u) * 0.75 + np.abs(v) + 0.08 * np.cos(10 * np.arctan2(v, u))
    index = (np.floor(radius * 5.0).astype(int) + 1) % 4
    small = (np.sin(u * 22) * np.sin(v * 22) > 0.55) & (radius > 0.45)
    index = np.where(small, (index + 2) % len(palette), index)
    border = np.floor(edge / 14).astype(int)
    zigzag = (np.abs(((x + y) % 28) - 14) < 7).astype(int)
    index = np.where(border < 4, np.where(border % 2 == 0, 3, 2 * zigzag), index)
    speckle = noise(rng, (height, width), (96, 144), octaves=2, gain=0.9)
    return Texture(to_image(np.asarray(palette, np.float32)[index] + 8.0 * speckle[..., None]))


def door_panel(rng: np.random.Generator) -> Texture:
    """A panelled door leaf with a handle."""
    speckle = noise(rng, (512, 224), (64, 32), octaves=2)
    image = np.asarray((226, 221, 210), np.float32) + 3.0 * speckle[..., None]
    for x0, x1 in ((22, 104), (120, 202)):
        for y0, y1 in ((28, 190), (214, 330), (352, 484)):
            cv2.rectangle(image, (x0, y0), (x1, y1), (168, 162, 150), 4)
            cv2.rectangle(image, (x0 + 10, y0 + 10), (x1 - 10, y1 - 10), (240, 236, 228), 3)
    cv2.line(image, (196, 268), (216, 268), (90, 84, 76), 8)
    return Texture(to_image(image))
