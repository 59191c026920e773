"""A contact sheet of a dataset: what a person sees at a glance and no number says.

One row per sampled frame: colour, depth, the edges of depth drawn over colour (they must lie on the
edges of things), and the frame put together with a later one that its poses carry here (a
chequerboard whose squares must fit).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.data.check import sampled
from magic_core.data.discovery import open_dataset
from magic_core.data.findings import DatasetReport
from magic_core.data.frame import Frame
from magic_core.data.sequence import FileSequence
from magic_core.errors import DataError
from magic_core.geometry import Camera, se3

Image = NDArray[np.uint8]

_TILE_WIDTH = 320
_ROWS = 8  # in all
_MARGIN, _LINE = 8, 20
_BACKGROUND, _TEXT = (24, 24, 24), (235, 235, 235)
_STATUS_COLOURS = {"ok": (120, 200, 120), "warn": (235, 190, 70), "fail": (240, 90, 80)}
_EDGE_COLOUR = (255, 60, 200)
_EDGE_STEP = 0.06  # relative jump of depth that is an edge
_CARRIED_FRAMES = 10
_CHEQUER = 40  # pixels
_COLUMNS = ("colour", "depth, near red to far blue", "edges of depth over colour",
            "chequered with a later frame, by the poses")  # fmt: skip


def draw_picture(report: DatasetReport, path: Path) -> Path:
    """Write the contact sheet of a checked dataset as PNG; DataError where nothing can be read."""
    sources = [s for s in open_dataset(str(report.path)) if isinstance(s, FileSequence)]
    each = max(1, _ROWS // max(1, len(sources)))
    rows, depths = [], []
    for source in sources:
        for index in sampled(source, each):
            try:
                frame = source[index]
                rows.append((f"{source.name} {frame.index}", source, frame, _later(source, index)))
            except DataError:  # the report names it; the others are worth seeing
                continue
            depths.append(frame.depth[frame.depth > 0])
    if not rows:
        raise DataError(f"{report.path}: no frame can be read, so there is no picture of it")
    known = np.concatenate(depths)
    near, far = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    lines = [_row(label, s.camera, f, later, (near, far)) for label, s, f, later in rows]
    sheet = np.vstack([_header(report, lines[0].shape[1], near, far), *lines])
    _, encoded = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; choose another file with --picture") from error
    return path


def coloured(depth: NDArray[np.float32], near: float, far: float) -> Image:
    """(h, w, 3) RGB of depth in metres: red is near, blue is far, black is no reading."""
    share = np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
    image = cv2.applyColorMap(np.rint(255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)
    rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    return np.where((depth > 0)[..., None], rgb, 0).astype(np.uint8)


def depth_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(h, w) where one surface ends before another; borders of missing readings are none."""
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        a, b = (depth[:-1], depth[1:]) if axis == 0 else (depth[:, :-1], depth[:, 1:])
        nearer = np.minimum(a, b)
        jump = (nearer > 0) & (np.abs(a - b) > _EDGE_STEP * nearer)
        edges[tuple(slice(n) for n in jump.shape)] |= jump
    return edges


def carried_colour(frame: Frame, into: Frame, camera: Camera) -> tuple[Image, NDArray[np.bool_]]:
    """Colour of `frame` as `into` would see it by both poses and depths, and where it is known."""
    assert frame.world_from_camera is not None
    assert into.world_from_camera is not None
    frame_from_into = se3.inverse(frame.world_from_camera) @ into.world_from_camera
    points = camera.back_project(into.depth).reshape(-1, 3)
    pixels, z = camera.project(se3.transform_points(frame_from_into, points))
    maps = pixels.astype(np.float32).reshape(*into.depth.shape, 2)
    carried = cv2.remap(frame.colour, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    u, v = maps[..., 0], maps[..., 1]
    inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    return np.asarray(carried, np.uint8), inside & (z.reshape(u.shape) > 0) & (into.depth > 0)


def _later(source: FileSequence, index: int) -> Frame | None:
    """The frame that is carried into `index`: some frames later, or earlier at the end."""
    other = index + _CARRIED_FRAMES
    if other >= len(source):
        other = index - _CARRIED_FRAMES
    if not 0 <= other < len(source) or source.files[index].world_from_camera is None:
        return None
    return None if source.files[other].world_from_camera is None else source[other]


def _row(
    label: str, camera: Camera, frame: Frame, later: Frame | None, span: tuple[float, float]
) -> Image:
    thick = np.ones((1 + round(camera.width / _TILE_WIDTH),) * 2, np.uint8)  # seen when shrunk
    edges = cv2.dilate(depth_edges(frame.depth).astype(np.uint8), thick) > 0
    overlay = frame.colour // 2
    overlay[edges] = _EDGE_COLOUR
    tiles = [_tile(frame.colour), _tile(coloured(frame.depth, *span), smooth=False),
             _tile(overlay, smooth=False), _tile(_chequered(frame, later, camera))]  # fmt: skip
    _write(tiles[0], label, (6, 16), _TEXT)
    if later is None:
        _write(tiles[3], "no poses", (6, 16), _TEXT)
    gap = np.full((tiles[0].shape[0], _MARGIN, 3), _BACKGROUND, np.uint8)
    parts = [gap]
    for tile in tiles:
        parts += [tile, gap]
    line = np.hstack(parts)
    below = np.full((_MARGIN, line.shape[1], 3), _BACKGROUND, np.uint8)
    return np.vstack([line, below])


def _chequered(frame: Frame, later: Frame | None, camera: Camera) -> Image:
    if later is None:
        return np.zeros_like(frame.colour)
    carried, known = carried_colour(later, frame, camera)
    size = max(2, _CHEQUER * camera.width // (2 * _TILE_WIDTH))
    v, u = np.indices(frame.depth.shape)
    squares = ((u // size + v // size) % 2 == 0) & known
    return np.where(squares[..., None], carried, frame.colour).astype(np.uint8)


def _tile(image: Image, *, smooth: bool = True) -> Image:
    height = round(image.shape[0] * _TILE_WIDTH / image.shape[1])
    shrink = image.shape[1] > _TILE_WIDTH and smooth
    how = cv2.INTER_AREA if shrink else cv2.INTER_NEAREST
    return np.array(cv2.resize(image, (_TILE_WIDTH, height), interpolation=how), np.uint8)


def _header(report: DatasetReport, width: int, near: float, far: float) -> Image:
    doubtful = [f for f in report.findings if f.status != "ok"]
    lines = [(f"{report.path}: {report.findings[0].detail}", _TEXT)]
    for found in doubtful:
        text = f"{found.status}: {found.name}: {found.remedy or found.detail}"
        lines.append((text, _STATUS_COLOURS[found.status]))
    if not doubtful:
        lines.append(("all checks passed", _STATUS_COLOURS["ok"]))
    lines.append((f"depth from {near:.3g} to {far:.3g} m", _TEXT))
    header = np.full((_LINE * (len(lines) + 1) + 2 * _MARGIN, width, 3), _BACKGROUND, np.uint8)
    for place, (text, colour) in enumerate(lines):
        _write(header, text, (_MARGIN, _MARGIN + _LINE * place + 14), colour)
    for column, name in enumerate(_COLUMNS):
        left = _MARGIN + column * (_TILE_WIDTH + _MARGIN)
        _write(header, name, (left, _MARGIN + _LINE * len(lines) + 14), _TEXT)
    return header


def _write(image: Image, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    plain = text.encode("ascii", "replace").decode()
    longest = int((image.shape[1] - place[0]) / 7.5)
    if len(plain) > longest:
        plain = plain[: longest - 3] + "..."
    (width, height), _ = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    left, base = place
    image[max(0, base - height - 4) : base + 5, max(0, left - 3) : left + width + 3] = _BACKGROUND
    cv2.putText(image, plain, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
