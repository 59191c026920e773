"""The database: one SQLite file in WAL mode, every commit on disk before it returns."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.ext.asyncio import AsyncConnection, create_async_engine

from magic_core.errors import WrongState
from magic_server.store import schema


class Database:
    """Connections to the store's database; one writer at a time, many readers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._engine = create_async_engine(f"sqlite+aiosqlite:///{path}", pool_size=4)
        self._write_lock = asyncio.Lock()
        event.listen(self._engine.sync_engine, "connect", _prepare_connection)

    async def open(self) -> None:
        """Create the tables where they are missing; WrongState for another schema version."""
        async with self._engine.begin() as connection:
            await connection.run_sync(schema.metadata.create_all)
            found = await connection.scalar(sa.select(schema.schema_version.c.version))
            if found is None:
                version = {"version": schema.SCHEMA_VERSION}
                await connection.execute(sa.insert(schema.schema_version), version)
        if found not in (None, schema.SCHEMA_VERSION):
            raise WrongState(
                f"{self.path} has schema version {found}, this build needs "
                f"{schema.SCHEMA_VERSION}; use the version of magic-slam that wrote it"
            )

    async def close(self) -> None:
        """Close every connection."""
        await self._engine.dispose()

    @asynccontextmanager
    async def read(self) -> AsyncIterator[AsyncConnection]:
        """A connection for reading."""
        async with self._engine.connect() as connection:
            yield connection

    @asynccontextmanager
    async def write(self) -> AsyncIterator[AsyncConnection]:
        """One transaction: durable when the block ends, undone when it raises."""
        async with self._write_lock, self._engine.begin() as connection:
            yield connection


def _prepare_connection(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    for pragma in (
        "journal_mode = WAL",
        "synchronous = FULL",  # a commit in WAL mode is only durable with this
        "foreign_keys = ON",
        "busy_timeout = 10000",
    ):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
