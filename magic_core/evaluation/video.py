"""Pictures in a row as a video file or as numbered PNG files.

Videos are VP9, which OpenCV's wheels encode and browsers and players show. H.264 they do not
encode.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import ConfigError, ResourceExhausted

VIDEO_SUFFIXES = (".mp4", ".webm")
_FOURCC = "vp09"


def write_frames(folder: Path, pictures: Iterable[NDArray[np.uint8]]) -> int:
    """Write (h, w, 3) RGB pictures as `frame_000000.png` and so on; returns how many."""
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for picture in pictures:
        path = folder / f"frame_{count:06d}.png"
        if not cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
            raise ResourceExhausted(f"{path} cannot be written; is the disk full?")
        count += 1
    return count


def write_video(
    path: Path, pictures: Iterable[NDArray[np.uint8]], *, size: tuple[int, int], fps: float
) -> int:
    """Write RGB pictures of one (width, height), both even, as a video; returns how many.

    The file appears when it is complete.
    """
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ConfigError.field("out", f"{path}: expected a name ending in .mp4 or .webm")
    if size[0] % 2 or size[1] % 2:
        raise ConfigError.field("width", f"{size[0]}x{size[1]}: a video needs even sides")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial.{path.name}")
    fourcc = cv2.VideoWriter.fourcc(*_FOURCC)
    writer = cv2.VideoWriter(str(partial), cv2.CAP_FFMPEG, fourcc, fps, size)
    try:
        if not writer.isOpened():
            raise ConfigError.field(
                "out", f"this OpenCV cannot encode {_FOURCC}; write a folder of frames instead"
            )
        count = 0
        for picture in pictures:
            writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            count += 1
        writer.release()
        partial.replace(path)
    finally:
        writer.release()
        partial.unlink(missing_ok=True)
    return count
