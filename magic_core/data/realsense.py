"""A RealSense camera, live: `realsense:` or `realsense://SERIAL?width=640&height=480&fps=30`.

Depth is aligned to colour by librealsense. `realsense:?file=recording.db3` plays a recording of
librealsense's through the same path. Needs the `realsense` extra (pyrealsense2).
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast
from urllib.parse import parse_qsl, unquote, urlsplit

import numpy as np

from magic_core.data.frame import UNLIMITED, EndOfFrames, Frame
from magic_core.data.images import ImagePreparation
from magic_core.data.intrinsics import Intrinsics
from magic_core.errors import DataError, NotSupported
from magic_core.geometry import Camera

SCHEME = "realsense:"
_FRAME_TIMEOUT_MS = 5000


@dataclass(frozen=True, slots=True)
class RealSenseOptions:
    """What the address of a camera says."""

    serial: str = ""
    """Serial number; empty = the only camera."""
    width: int = 640
    height: int = 480
    fps: int = 30
    file: str = ""
    """A recording of librealsense's to play instead."""


def parse_address(address: str) -> RealSenseOptions:
    """Options from `realsense://SERIAL?width=..`; DataError names what it does not understand."""
    parts = urlsplit(address)
    try:
        given = dict(
            parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
        )
        file = unquote(given.pop("file", ""))
        sizes = {key: int(value) for key, value in given.items()}
        unknown = set(sizes) - {"width", "height", "fps"}
        if unknown or any(value < 1 for value in sizes.values()):
            raise ValueError(f"unknown or impossible {', '.join(sorted(unknown or sizes))}")
        return RealSenseOptions(serial=parts.netloc or parts.path, file=file, **sizes)
    except ValueError as error:
        raise DataError(
            f"{address}: {error}; expected realsense://SERIAL?width=640&height=480&fps=30, "
            "serial and options as needed"
        ) from error


class RealSenseSource:
    """A FrameSource that delivers the camera's next frame; the camera starts when first used."""

    def __init__(
        self,
        address: str,
        *,
        name: str = "agent_0",
        scale: float = 1.0,
        max_frames: int | None = None,
        stride: int = 1,
    ) -> None:
        if max_frames is not None and max_frames < 1:
            raise DataError(f"max_frames {max_frames}: expected 1 or more, or nothing for all")
        if stride < 1:
            raise DataError(f"stride {stride}: expected 1 (every frame) or more")
        self.name = name
        self._options = parse_address(address)
        self._library = _load_library()
        self._stride, self._length = stride, max_frames or UNLIMITED
        self._pipeline, profile = self._start()
        weakref.finalize(self, _stop, self._pipeline)
        self._align = self._library.align(self._library.stream.color)
        self._depth_unit_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
        stream = profile.get_stream(self._library.stream.color).as_video_stream_profile()
        self._preparation = ImagePreparation.plan(_intrinsics(stream.get_intrinsics()), scale)
        self.camera = self._preparation.camera
        self._delivered = 0
        self._latest: Frame | None = None
        self._last_time_s = float("-inf")

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self._delivered, self._length):
            try:
                yield self[index]
            except EndOfFrames:
                return

    def __getitem__(self, index: int) -> Frame:
        """The next frame; the latest one once more where `index` is its number."""
        if self._latest is not None and index == self._latest.index:
            return self._latest
        if self._delivered >= self._length:
            raise EndOfFrames(f"{self._length} frames were delivered, as asked")
        for _ in range(self._stride - 1):
            self._next()
        self._latest = self._frame(self._next())
        self._delivered += 1
        return self._latest

    def _start(self) -> tuple[Any, Any]:
        rs, options = self._library, self._options
        pipeline, config = rs.pipeline(), rs.config()
        if options.file:
            config.enable_device_from_file(options.file, repeat_playback=False)
        else:
            if options.serial:
                config.enable_device(options.serial)
            size = (options.width, options.height)
            config.enable_stream(rs.stream.depth, *size, rs.format.z16, options.fps)
            config.enable_stream(rs.stream.color, *size, rs.format.rgb8, options.fps)
        try:
            profile = pipeline.start(config)
            if options.file:  # a recording waits for its reader, a camera does not
                profile.get_device().as_playback().set_real_time(False)
            return pipeline, profile
        except RuntimeError as error:
            what = options.file or options.serial or "camera"
            raise DataError(
                f"RealSense {what}: {error}; is it plugged into USB 3, free, and able to deliver "
                f"{options.width}x{options.height} at {options.fps} Hz? `rs-enumerate-devices` "
                "lists what there is"
            ) from error

    def _next(self) -> Any:
        """The next pair of images that is newer than the last."""
        while True:
            try:
                pair = self._pipeline.wait_for_frames(_FRAME_TIMEOUT_MS)
            except RuntimeError as error:
                raise EndOfFrames(f"the camera sends no more frames: {error}") from error
            colour, depth = pair.get_color_frame(), pair.get_depth_frame()
            if colour and depth and 1e-3 * colour.get_timestamp() > self._last_time_s:
                self._last_time_s = 1e-3 * colour.get_timestamp()
                return pair

    def _frame(self, pair: Any) -> Frame:
        aligned = self._align.process(pair)
        colour = np.asanyarray(aligned.get_color_frame().get_data())
        units = np.asanyarray(aligned.get_depth_frame().get_data())
        depth = units.astype(np.float32) * np.float32(self._depth_unit_m)
        return Frame(
            index=self._delivered,
            timestamp_s=self._last_time_s,
            colour=self._preparation.colour(np.array(colour, dtype=np.uint8)),
            depth=self._preparation.depth(depth),
        )


def _load_library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise NotSupported(
            "a live RealSense camera needs pyrealsense2, which is not installed: "
            "pip install 'magic-slam[realsense]'"
        ) from error
    return cast(Any, pyrealsense2)


def _stop(pipeline: Any) -> None:
    pipeline.stop()


def _intrinsics(lens: Any) -> Intrinsics:
    camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy)
    coefficients = tuple(float(value) for value in lens.coeffs)
    model = str(lens.model).rsplit(".", 1)[-1]
    if not any(coefficients):
        coefficients = ()
    elif model != "brown_conrady":
        raise DataError(
            f"the colour lens has the distortion model {model} with {coefficients}; expected "
            "brown_conrady or no distortion. Choose a rectified stream."
        )
    return Intrinsics(camera, 1.0, coefficients)
