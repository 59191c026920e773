"""Settings of one agent: its local SLAM, and how it talks to the server."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from magic_agent.slam_config import SlamConfig
from magic_core.errors import ConfigError

MOST_DESCRIBED = 32
"""Described keyframes of a sub-map; what a server takes unless it is set otherwise."""


@dataclass(frozen=True, slots=True)
class UplinkConfig:
    """How sub-maps reach the server."""

    lossless: bool = False
    """Send float32 Gaussians and PNG colour instead of the compact codec and JPEG."""
    first_retry_s: float = 0.5
    """Wait after the first failed attempt; doubles up to `longest_retry_s`."""
    longest_retry_s: float = 15.0
    """Longest wait between attempts."""
    give_up_after_s: float = 600.0
    """When the sequence is over, how long to go on trying before leaving the rest in the spool."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig(SlamConfig):
    """One agent: tracking, mapping and sub-maps, its image encoder and its link to the server."""

    places_model: str = "efficientnet_lite0"
    """Image encoder for place recognition: a name, or the path of an ONNX file. All agents of a
    session use the same."""
    places_keyframes: int = 0
    """So many keyframes of a sub-map are described beside its anchor, at most: those that show
    something else. Places are then found by these views too; 0 describes anchors alone."""
    known_start: bool = False
    """Start from the first ground-truth pose of the data (the paper's setting) instead of an
    unknown pose."""
    rate_hz: Annotated[float, tyro.conf.arg(aliases=("--rate",))] = 0.0
    """Play the data in real time at this many frames per second, dropping what cannot be kept up
    with; 0 processes every frame, however long it takes."""
    queue_frames: int = 4
    """Frames read ahead of tracking at most."""
    uplink: UplinkConfig = field(default_factory=UplinkConfig)

    def validate(self) -> None:
        """Raise ConfigError naming the first value that an agent cannot run with."""
        if not 0.0 <= self.rate_hz < math.inf:
            raise ConfigError.field("rate_hz", f"{self.rate_hz}: expected 0 or more frames per s")
        if self.queue_frames < 1:
            raise ConfigError.field("queue_frames", f"{self.queue_frames}: expected at least 1")
        if not 0 <= self.places_keyframes <= MOST_DESCRIBED:
            raise ConfigError.field(
                "places_keyframes", f"{self.places_keyframes}: expected 0 to {MOST_DESCRIBED}"
            )
        self.submap.validate()
        self.mapping.resolved()
