"""Which database the store uses."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from magic_core.errors import ConfigError

EXAMPLE = "postgresql+asyncpg://USER:PASSWORD@HOST:5432/DATABASE"


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """The database: SQLite in the data folder, or a PostgreSQL server."""

    database: str = field(default="", repr=False)
    """Address of a PostgreSQL database, postgresql+asyncpg://USER@HOST:PORT/NAME; empty for SQLite
    in the data folder. Everyone on this machine sees command lines: an address with a password
    belongs in database_file or database_env."""
    database_file: Path | None = None
    """File whose first line is that address; used where `database` is empty."""
    database_env: str = "MAGIC_DATABASE"
    """Environment variable that holds it; used where neither of the others is set."""
    index: Literal["faiss", "pgvector"] = "faiss"
    """Where descriptors are searched: in this process, or by the database's pgvector."""
    connections: int = 8
    """Connections to PostgreSQL at most."""
    connect_timeout_s: float = 10.0
    """How long PostgreSQL may take to accept one, seconds."""

    def __post_init__(self) -> None:
        if self.connections < 2:
            raise ConfigError.field("store.connections", f"{self.connections}: expected at least 2")
        if not self.connect_timeout_s > 0.0:
            raise ConfigError.field(
                "store.connect_timeout_s", f"{self.connect_timeout_s}: expected above 0 s"
            )

    def address(self) -> str:
        """The database's address; empty for SQLite. ConfigError for a file that has none."""
        if self.database:
            return self.database
        if self.database_file is None:
            return os.environ.get(self.database_env, "").strip()
        try:
            lines = self.database_file.read_text(encoding="utf-8").split()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError.field(
                "store.database_file", f"{self.database_file} cannot be read: {error}"
            ) from error
        if len(lines) != 1:
            raise ConfigError.field(
                "store.database_file",
                f"{self.database_file} has {len(lines)} words; expected one line: {EXAMPLE}",
            )
        return lines[0]
