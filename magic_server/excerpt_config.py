"""Settings of the files made of parts of maps."""

from __future__ import annotations

from dataclasses import dataclass

from magic_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class ExcerptConfig:
    """Parts of maps: regions, and levels of detail."""

    most: int = 16
    """Files of parts at a time, those being made or sent included; while all are in use further
    parts are refused for now."""
    kept_bytes: int = 1 << 30
    """Bytes of files that are kept for whoever asks for the same part next."""
    kept_s: float = 600.0
    """How long such a file is kept, seconds."""
    idle_s: float = 60.0
    """A download that takes nothing for this long is ended, seconds."""

    def __post_init__(self) -> None:
        if self.most < 1 or self.kept_bytes < 0:
            raise ConfigError.field("excerpts", "most is 1 or more, kept_bytes 0 or more")
        for name in ("kept_s", "idle_s"):
            if not 0.0 < (value := getattr(self, name)) <= 86400.0:
                raise ConfigError.field(
                    f"excerpts.{name}", f"{value}: expected above 0, up to 86400 s"
                )
