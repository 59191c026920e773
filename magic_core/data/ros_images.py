"""ROS image and calibration messages as arrays: sensor_msgs Image, CompressedImage, CameraInfo."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.data.images import Colour, Depth
from magic_core.data.pose_files import valid_camera
from magic_core.errors import DataError
from magic_core.geometry import Camera

_CHANNELS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "8uc1": 1, "8uc3": 3,
             "8uc4": 4, "yuv422_yuy2": 2, "yuv422": 2, "yuyv": 2, "uyvy": 2}  # fmt: skip
_TO_RGB = {
    "mono8": cv2.COLOR_GRAY2RGB, "8uc1": cv2.COLOR_GRAY2RGB,
    "bgr8": cv2.COLOR_BGR2RGB, "8uc3": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB, "8uc4": cv2.COLOR_BGRA2RGB,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2, "yuyv": cv2.COLOR_YUV2RGB_YUY2,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY,
}  # fmt: skip
_DEPTH_TYPES = {"16uc1": "u2", "mono16": "u2", "32fc1": "f4"}
_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")
_IDEAL_MODELS = ("", "none")
_LENS_MODELS = ("plumb_bob", "rational_polynomial", "brown_conrady", "radtan")
_LENS_COEFFICIENTS = (4, 5, 8, 12, 14)


def colour_image(message: Any, *, where: str) -> Colour:
    """(h, w, 3) RGB of an Image or CompressedImage."""
    if hasattr(message, "format"):
        image = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise DataError(f"{where}: a {message.format!r} image that cannot be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    encoding = message.encoding.lower()
    if encoding not in _CHANNELS:
        raise DataError(
            f"{where}: encoding {message.encoding!r}; expected one of {', '.join(_CHANNELS)}"
        )
    pixels = _pixels(message, np.dtype("u1"), _CHANNELS[encoding], where)
    if encoding == "rgb8":
        return np.ascontiguousarray(pixels)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), _TO_RGB[encoding]), np.uint8)


def depth_image(message: Any, *, units_per_metre: float, where: str) -> Depth:
    """(h, w) metres of an Image or a compressedDepth CompressedImage; 0 = no reading.

    Whole numbers are units of which `units_per_metre` make a metre; floats are metres (REP 118).
    """
    if hasattr(message, "format"):
        values = _compressed_depth(message, where)
    else:
        kind = _DEPTH_TYPES.get(message.encoding.lower())
        if kind is None:
            raise DataError(
                f"{where}: depth encoding {message.encoding!r}; expected 16UC1 (millimetres) or "
                "32FC1 (metres)"
            )
        order = ">" if message.is_bigendian else "<"
        values = _pixels(message, np.dtype(order + kind), 1, where)[..., 0]
    if values.dtype.kind == "f":
        return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)
    return values.astype(np.float32) / np.float32(units_per_metre)


def camera_of(info: Any, *, where: str) -> tuple[Camera, tuple[float, ...]]:
    """The camera and OpenCV distortion of a CameraInfo."""
    k = np.asarray(info.K if hasattr(info, "K") else info.k, dtype=np.float64)
    coefficients = np.asarray(info.D if hasattr(info, "D") else info.d, dtype=np.float64)
    fx, fy, cx, cy = (float(k[place]) for place in (0, 4, 2, 5))
    camera = valid_camera(Camera(int(info.width), int(info.height), fx, fy, cx, cy), where=where)
    if not coefficients.any():
        return camera, ()
    model = info.distortion_model.lower().replace(" ", "_")
    if model in _IDEAL_MODELS:
        return camera, ()
    if model not in _LENS_MODELS or len(coefficients) not in _LENS_COEFFICIENTS:
        raise DataError(
            f"{where}: distortion model {info.distortion_model!r} with {len(coefficients)} "
            f"coefficients; expected {' or '.join(_LENS_MODELS)}. Record rectified images instead."
        )
    return camera, tuple(float(value) for value in coefficients)


def _pixels(message: Any, kind: np.dtype, channels: int, where: str) -> NDArray[Any]:
    """(h, w, channels), without the padding at the end of each row."""
    row = message.width * channels * kind.itemsize
    data = np.asarray(message.data, np.uint8)
    step = message.step or row
    if step < row or len(data) < step * message.height:
        raise DataError(
            f"{where}: {len(data)} bytes for {message.width}x{message.height} {message.encoding} "
            f"with {step} bytes per row; the recording is damaged"
        )
    rows = data[: step * message.height].reshape(message.height, step)[:, :row]
    values = np.ascontiguousarray(rows).view(kind)
    return values.reshape(message.height, message.width, channels)


def _compressed_depth(message: Any, where: str) -> NDArray[Any]:
    """The compressed_depth_image_transport format: 12 bytes of parameters, then a 16-bit PNG."""
    data = np.asarray(message.data, np.uint8)
    header = b"" if "compresseddepth" not in message.format.lower() else data[:12].tobytes()
    image = cv2.imdecode(data[len(header) :], cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        raise DataError(
            f"{where}: depth of format {message.format!r} is no 16-bit PNG; record the depth "
            "topic uncompressed, or as compressedDepth with PNG"
        )
    if not header or not message.format.lower().startswith("32fc1"):
        return image
    _, a, b = _COMPRESSED_DEPTH_HEADER.unpack(header)  # inverse depth, quantised
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(image > 0, a / (image.astype(np.float32) - b), 0).astype(np.float32)
