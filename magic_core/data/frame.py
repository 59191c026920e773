"""One RGB-D frame, and what every source of frames offers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core.geometry import Camera


@dataclass(frozen=True, slots=True)
class Frame:
    """A colour image and the depth image registered to it."""

    index: int
    """0-based number within the sequence."""
    timestamp_s: float
    """Sensor time in seconds; strictly increasing within a sequence."""
    colour: NDArray[np.uint8]  # (h, w, 3) RGB
    depth: NDArray[np.float32]  # (h, w) metres along z; 0 = no reading
    world_from_camera: NDArray[np.float64] | None = None
    """Ground truth where the sequence has it. For evaluation alone: never enters the pipeline,
    except as the prior of the first pose when the user asks for a known start."""


UNLIMITED = 2**31 - 1
"""Length of a live source that nobody limited: as long as the camera runs."""


class EndOfFrames(Exception):
    """A live source has ended, for good: what was seen so far can be finished."""


class FrameSource(Protocol):
    """A sequence of frames of one camera; frames are read lazily, one at a time.

    A live source delivers the next frame whatever index is asked for, and raises EndOfFrames when
    no more will come; its length is the most frames that it would deliver, or UNLIMITED.
    """

    name: str
    """The agent's name, for example `agent_0`."""
    camera: Camera
    """Intrinsics of the frames as they are delivered (after scaling)."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Frame]: ...

    def __getitem__(self, index: int) -> Frame: ...
