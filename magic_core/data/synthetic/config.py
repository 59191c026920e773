"""What a recording of the synthetic flat is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from magic_core.errors import ConfigError
from magic_core.geometry import Camera

Detail = Literal["full", "draft"]


@dataclass(frozen=True, slots=True)
class SyntheticConfig:
    """A recording of the synthetic flat."""

    agents: int = 3
    """How many agents walk."""
    frames: int = 120
    """Frames of each agent."""
    width: int = 320
    """Image width in pixels."""
    height: int = 240
    """Image height in pixels."""
    field_of_view_deg: float = 74.0
    """Horizontal field of view."""
    depth_noise: bool = True
    """Kinect-like noise, quantisation and holes; without it depth is exact."""
    seed: int = 0
    """Decides textures, small objects, paths and noise."""
    rate_hz: float = 30.0
    """Frames per second of the timestamps."""
    detail: Detail = "full"
    """How finely light is computed; `draft` is for tests."""

    def validate(self) -> None:
        """Raise ConfigError for values that no recording can have."""
        rules = (
            ("agents", 1 <= self.agents <= 64, "1 to 64"),
            ("frames", 1 <= self.frames <= 100_000, "1 to 100000"),
            ("width", 16 <= self.width <= 4096, "16 to 4096 pixels"),
            ("height", 16 <= self.height <= 4096, "16 to 4096 pixels"),
            ("field_of_view_deg", 20 <= self.field_of_view_deg <= 130, "20 to 130 degrees"),
            ("rate_hz", self.rate_hz > 0, "more than 0"),
            ("detail", self.detail in ("full", "draft"), "full or draft"),
        )
        for name, holds, rule in rules:
            if not holds:
                raise ConfigError.field(name, f"{getattr(self, name)}: expected {rule}")

    @property
    def camera(self) -> Camera:
        """The camera of the frames at full size."""
        focal = 0.5 * self.width / np.tan(np.deg2rad(self.field_of_view_deg) / 2)
        return Camera(
            width=self.width,
            height=self.height,
            fx=float(focal),
            fy=float(focal),
            cx=(self.width - 1) / 2,
            cy=(self.height - 1) / 2,
        )
