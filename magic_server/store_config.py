"""Which database the store uses, and where its blobs are."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from magic_core.errors import ConfigError

_BUCKET = re.compile(r"s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/[A-Za-z0-9_.=-]+)*/?")
_ENDPOINT = re.compile(
    r"https?://[A-Za-z0-9._-]+(:\d{1,5})?/?|https?://\[[0-9a-fA-F:]+\](:\d{1,5})?/?"
)
_LEAST_PART = 5 << 20
"""S3 takes no smaller parts but the last."""
EXAMPLE = "postgresql+asyncpg://USER:PASSWORD@HOST:5432/DATABASE"


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """The database: SQLite in the data folder, or a PostgreSQL server. Blobs: files, or S3."""

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
    blobs: str = ""
    """Bucket for images, Gaussians and maps, s3://BUCKET/PREFIX; empty for files in the data
    folder. Credentials come from the environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, or
    AWS_PROFILE) or the usual AWS files."""
    s3_endpoint: str = ""
    """URL of the S3 server, https://HOST:PORT; empty for AWS."""
    s3_region: str = ""
    """Region of the bucket; empty for that of the environment."""
    s3_part_bytes: int = 16 << 20
    """Blobs of more than two of these are uploaded in parts of this length, and what streams
    through the server is held in memory up to this."""
    s3_timeout_s: float = 15.0
    """How long the S3 server may be silent before a request is given up, seconds."""
    blob_cache_bytes: int = 1 << 30
    """What a machine may keep on its disk of the blobs that its jobs read from a bucket; 0 for
    nothing."""

    def __post_init__(self) -> None:
        if self.connections < 2:
            raise ConfigError.field("store.connections", f"{self.connections}: expected at least 2")
        if not self.connect_timeout_s > 0.0:
            raise ConfigError.field(
                "store.connect_timeout_s", f"{self.connect_timeout_s}: expected above 0 s"
            )

        self._check_bucket()

    def _check_bucket(self) -> None:
        # Neither value is repeated where it may hold credentials.
        if self.blobs and not _BUCKET.fullmatch(self.blobs):
            raise ConfigError.field(
                "store.blobs",
                "expected s3://BUCKET or s3://BUCKET/PREFIX, credentials in the environment",
            )
        if self.s3_endpoint and not _ENDPOINT.fullmatch(self.s3_endpoint):
            raise ConfigError.field(
                "store.s3_endpoint",
                "expected https://HOST:PORT or http://HOST:PORT, credentials in the environment",
            )
        if not self.blobs and (self.s3_endpoint or self.s3_region):
            raise ConfigError.field(
                "store.blobs", "s3_endpoint and s3_region are for a bucket; give s3://BUCKET/PREFIX"
            )
        if self.s3_part_bytes < _LEAST_PART:
            raise ConfigError.field(
                "store.s3_part_bytes", f"{self.s3_part_bytes}: expected at least {_LEAST_PART}"
            )
        if not 0.0 < self.s3_timeout_s <= 3600.0 or self.blob_cache_bytes < 0:
            raise ConfigError.field(
                "store", "s3_timeout_s is above 0, and blob_cache_bytes 0 or more"
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
