"""The database: one SQLite file in WAL mode, every commit on disk before it returns."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import OperationalError
from sqlalchemy.ext.asyncio import AsyncConnection, create_async_engine

from magic_core.errors import DiskFull, WrongState
from magic_server.store import schema
from magic_server.store.blobs import DISK_RETRY_S

# A full disk shows as either, depending on which file had to grow.
_NO_ROOM = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_SHMSIZE)


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
        """One transaction: durable when the block ends, undone when it raises.

        Raises DiskFull when the disk has no room for it.
        """
        try:
            async with self._write_lock, self._engine.begin() as connection:
                yield connection
        except OperationalError as error:
            if getattr(error.orig, "sqlite_errorcode", None) in _NO_ROOM:
                message = "the server's disk is full; try again once there is room"
                raise DiskFull(message, retry_after_s=DISK_RETRY_S) from error
            raise


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
