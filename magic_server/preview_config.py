"""Settings of the merged preview."""

from __future__ import annotations

from dataclasses import dataclass

from magic_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PreviewConfig:
    """The merged preview of sessions in progress."""

    enabled: bool = True
    """Keep it up to date while agents run; otherwise it is made when somebody asks."""
    interval_s: float = 3.0
    """Least time between two previews of a session, seconds."""

    def __post_init__(self) -> None:
        if self.interval_s <= 0.0:
            raise ConfigError.field("preview.interval_s", f"{self.interval_s}: expected above 0 s")
