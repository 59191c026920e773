"""What is kept of uploads that broke off."""

from __future__ import annotations

from dataclasses import dataclass

from magic_core.errors import ConfigError, FieldViolation


@dataclass(frozen=True, slots=True)
class PartialUploadLimits:
    """Bounds on uploads that wait to be resumed; the oldest is dropped when one is passed.

    Dropping costs nothing but bytes: the client has the sub-map and starts it over.
    """

    max_age_s: float = 86400.0
    """Dropped when nobody goes on with it for this long, seconds."""
    max_bytes: int = 8 << 30
    """Bytes of all of them."""
    max_count: int = 256
    """Their number."""
    max_per_agent: int = 8
    """Their number per agent."""
    sync_bytes: int = 8 << 20
    """While a stream goes on, at most this much is not yet safe from a loss of power."""

    def __post_init__(self) -> None:
        found = [
            FieldViolation(f"partial_uploads.{name}", f"{getattr(self, name)}: expected above 0")
            for name in ("max_age_s", "max_bytes", "max_count", "max_per_agent", "sync_bytes")
            if not getattr(self, name) > 0
        ]
        if found:
            raise ConfigError(f"{found[0].field}: {found[0].description}", violations=tuple(found))
