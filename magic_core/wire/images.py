"""Colour and depth images as bytes; sizes are read from the header before anything is decoded."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import CorruptData, InvalidInput
from magic_core.wire import depth_planes

JPEG, PNG = "image/jpeg", "image/png"
DEPTH_PLANES = depth_planes.MEDIA_TYPE
COLOUR_MEDIA_TYPES = (JPEG, PNG)
DEPTH_MEDIA_TYPES = (DEPTH_PLANES, PNG)
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_STANDALONE_MARKERS = frozenset((0x01, *range(0xD0, 0xD8)))
_PNG_GREY, _PNG_RGB = 0, 2
MAX_PIXELS = 64_000_000
"""Larger images are refused by their header, before anything is decoded."""
MAX_JPEG_SCANS = 100
"""A progressive JPEG may ask for the whole image to be gone through again with every few bytes."""
_MAX_PNG_CHUNKS = 100
_START_OF_SCAN = b"\xff\xda"


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What an encoded image says about itself."""

    width: int
    height: int
    bits: int
    """Bits per channel."""
    channels: int


def encode_colour_jpeg(colour: NDArray[np.uint8], *, quality: int = 95) -> bytes:
    """(h, w, 3) RGB as JPEG with the given quality, 1 to 100, and Huffman tables of its own."""
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return _encode(".jpg", _bgr(colour), parameters)


def encode_colour_png(colour: NDArray[np.uint8]) -> bytes:
    """(h, w, 3) RGB as PNG, lossless."""
    return _encode(".png", _bgr(colour), [cv2.IMWRITE_PNG_COMPRESSION, 3])


def encode_depth(depth: NDArray[np.float32], *, metres_per_unit: float = 0.001) -> bytes:
    """(h, w) depth in metres in planes; what does not fit 16 bits becomes "no reading"."""
    return depth_planes.encode(_in_units(depth, metres_per_unit))


def encode_depth_png(depth: NDArray[np.float32], *, metres_per_unit: float = 0.001) -> bytes:
    """(h, w) depth in metres as 16-bit grey PNG; what does not fit 16 bits becomes "no reading"."""
    # One filter for all rows: the usual choice row by row looks at bytes, not at 16-bit values.
    filtered = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    units = _in_units(depth, metres_per_unit)
    return _encode(".png", units, [cv2.IMWRITE_PNG_COMPRESSION, 6, *filtered])


def decode_colour(data: bytes, media_type: str, *, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(h, w, 3) RGB of a JPEG or PNG that must have `size` = (width, height) pixels."""
    return np.ascontiguousarray(_colour_pixels(data, media_type, size)[:, :, ::-1])


def decode_depth(
    data: bytes, media_type: str, *, metres_per_unit: float, size: tuple[int, int]
) -> NDArray[np.float32]:
    """(h, w) depth in metres of an image in planes, or a 16-bit grey PNG, of `size` = (width,
    height) pixels."""
    units = _depth_units(data, media_type, size)
    return units.astype(np.float32) * np.float32(metres_per_unit)


def read_header(data: bytes, media_type: str) -> ImageHeader:
    """Size, bits and channels from the first bytes; CorruptData when they are not that format."""
    if media_type == PNG:
        return _png_header(data)
    if media_type == JPEG:
        return _jpeg_header(data)
    if media_type == DEPTH_PLANES:
        return ImageHeader(*depth_planes.read_size(data), bits=16, channels=1)
    expected = f"expected {JPEG}, {PNG} or {DEPTH_PLANES}"
    raise InvalidInput.field("media_type", f"{media_type!r}, {expected}")


def check_image(data: bytes, media_type: str, *, size: tuple[int, int], depth: bool) -> None:
    """Raise unless the bytes decode to an image of the right kind and (width, height)."""
    if depth:
        _depth_units(data, media_type, size)
    else:
        _colour_pixels(data, media_type, size)


def _colour_pixels(data: bytes, media_type: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(h, w, 3) BGR."""
    header = read_header(data, media_type)
    _require(header, size, bits=8, channels=(3,), what="colour image")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return _decode(data, flags, media_type)


def _depth_units(data: bytes, media_type: str, size: tuple[int, int]) -> NDArray[np.uint16]:
    """(h, w) in units."""
    _require(read_header(data, media_type), size, bits=16, channels=(1,), what="depth image")
    if media_type == DEPTH_PLANES:
        return depth_planes.decode(data)
    return _decode(data, cv2.IMREAD_UNCHANGED, media_type)


def _png_header(data: bytes) -> ImageHeader:
    if len(data) < 33 or data[:8] != _PNG_SIGNATURE or data[12:16] != b"IHDR":
        raise CorruptData("not a PNG: the signature or the IHDR chunk is missing")
    _require_still(data)
    width, height, bits, colour_type = struct.unpack(">IIBB", data[16:26])
    channels = {_PNG_GREY: 1, _PNG_RGB: 3, 3: 1, 4: 2, 6: 4}.get(colour_type, 0)
    return ImageHeader(width, height, bits if colour_type != 3 else 0, channels)


def _require_still(data: bytes) -> None:
    """Refuse an animated PNG, whose frames have sizes of their own, by the chunks before IDAT."""
    position = 8
    for _ in range(_MAX_PNG_CHUNKS):
        kind = data[position + 4 : position + 8]
        if kind == b"acTL":
            raise InvalidInput("the PNG is animated; send a still image")
        if kind in (b"IDAT", b"IEND", b""):
            return
        position += 12 + int.from_bytes(data[position : position + 4], "big")
    raise CorruptData(f"not a PNG that is read here: {_MAX_PNG_CHUNKS} chunks before its pixels")


def _jpeg_header(data: bytes) -> ImageHeader:
    """Walk the segments up to the start of frame (ITU-T T.81, annex B)."""
    if data[:2] != b"\xff\xd8":
        raise CorruptData("not a JPEG: the start marker is missing")
    # Within a scan 0xFF is always escaped, so the marker is never part of the pixels.
    if (scans := data.count(_START_OF_SCAN)) > MAX_JPEG_SCANS:
        raise InvalidInput(f"the JPEG has {scans} scans, at most {MAX_JPEG_SCANS} are decoded")
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF or marker in _STANDALONE_MARKERS:
            position += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_START_OF_FRAME:
            if position + 10 > len(data):
                break
            bits, height, width, channels = struct.unpack_from(">BHHB", data, position + 4)
            return ImageHeader(width, height, bits, channels)
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    raise CorruptData("not a JPEG: no start of frame found")


def _require(
    header: ImageHeader, size: tuple[int, int], *, bits: int, channels: tuple[int, ...], what: str
) -> None:
    if header.width * header.height > MAX_PIXELS:
        found = f"{header.width}x{header.height}"
        raise InvalidInput(f"{what} is {found}, at most {MAX_PIXELS} pixels are decoded")
    if (header.width, header.height) != size:
        found = f"{header.width}x{header.height}"
        raise InvalidInput(f"{what} is {found}, the camera says {size[0]}x{size[1]}")
    if header.bits != bits or header.channels not in channels:
        raise InvalidInput(
            f"{what} has {header.channels} channels of {header.bits} bits, "
            f"expected {channels[0]} of {bits}"
        )


def _in_units(depth: NDArray[np.float32], metres_per_unit: float) -> NDArray[np.uint16]:
    units = np.rint(np.nan_to_num(depth, posinf=0.0, neginf=0.0) / metres_per_unit)
    return np.where((units >= 0) & (units <= 65535), units, 0).astype(np.uint16)


def _bgr(colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(colour[:, :, ::-1])


def _encode(suffix: str, image: NDArray, parameters: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, image, parameters)
    if not done:
        raise InvalidInput(f"cannot encode an image of shape {image.shape} as {suffix}")
    return data.tobytes()


def _decode(data: bytes, flags: int, media_type: str) -> NDArray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise CorruptData(f"{media_type} does not decode: {error}") from error
    if image is None:
        raise CorruptData(f"{media_type} does not decode")
    return image
