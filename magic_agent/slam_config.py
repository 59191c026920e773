"""Settings of one agent's local SLAM."""

from __future__ import annotations

from dataclasses import dataclass, field

from magic_agent.mapping.config import MappingConfig
from magic_agent.tracking.config import TrackingConfig
from magic_core.errors import ConfigError, FieldViolation


@dataclass(frozen=True, slots=True)
class SubmapConfig:
    """When an agent closes a sub-map and starts the next."""

    frames: int = 45
    """Frames per sub-map at most."""
    min_frames: int = 15
    """Frames per sub-map at least; hand-over by motion waits for it."""
    translation_m: float = 2.0
    """Distance from the anchor, in metres, that starts a new sub-map."""
    rotation_deg: float = 90.0
    """Turn from the anchor, in degrees, that starts a new sub-map."""
    min_anchor_overlap: float = 0.1
    """A new sub-map starts where the anchor's image shows less than this share of the frame."""
    send_all: bool = False
    """Send also the Gaussians that the next sub-map takes over (an ablation: the paper's sub-maps
    are without them)."""
    max_lost_frames: int = 10
    """Usable frames in a row without a pose before a new sub-map starts without odometry."""
    min_depth_share: float = 0.1
    """Share of pixels with depth below which a frame cannot be used."""
    drift_translation_m: float = 0.004
    """Standard deviation that one hand-over adds to the odometry edge, metres."""
    drift_rotation_deg: float = 0.1
    """Standard deviation that one hand-over adds to the odometry edge, degrees."""

    def validate(self) -> None:
        """Raise ConfigError naming each value that no sub-map can be made with."""
        rules = {
            "frames": (self.frames >= 2, "expected at least 2"),
            "min_frames": (1 <= self.min_frames <= self.frames, "expected 1 to submap.frames"),
            "max_lost_frames": (self.max_lost_frames >= 1, "expected at least 1"),
            "min_anchor_overlap": (0.0 <= self.min_anchor_overlap < 1.0, "expected 0 to 1"),
            "min_depth_share": (0.0 <= self.min_depth_share < 1.0, "expected 0 to 1"),
            "drift_translation_m": (self.drift_translation_m > 0, "expected more than 0 m"),
            "drift_rotation_deg": (self.drift_rotation_deg > 0, "expected more than 0 degrees"),
        }
        found = [
            FieldViolation(f"submap.{name}", f"{getattr(self, name)}: {rule}")
            for name, (holds, rule) in rules.items()
            if not holds
        ]
        if found:
            raise ConfigError(f"{found[0].field}: {found[0].description}", violations=tuple(found))


@dataclass(frozen=True, slots=True)
class SlamConfig:
    """Tracking, mapping and sub-maps of one agent."""

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    submap: SubmapConfig = field(default_factory=SubmapConfig)
    seed: int = 0
    """Seed of everything random in the agent; equal seeds and frames give equal results."""
    threads: int = 0
    """Threads of the rasteriser; 0 takes its own default."""
