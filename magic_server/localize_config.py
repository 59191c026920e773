"""Settings of Localize."""

from __future__ import annotations

from dataclasses import dataclass

from magic_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class LocalizeConfig:
    """How images are placed in the stored map."""

    candidates: int = 6
    """So many of the sub-maps that look most alike are tried, the most similar first."""
    max_pixels: int = 8_000_000
    """Largest image, pixels."""
    waiting: int = 16
    """Requests at a time; further ones are refused with RESOURCE_EXHAUSTED."""

    def __post_init__(self) -> None:
        for name in ("candidates", "max_pixels", "waiting"):
            if getattr(self, name) < 1:
                raise ConfigError.field(f"localize.{name}", f"{getattr(self, name)}: expected >= 1")
