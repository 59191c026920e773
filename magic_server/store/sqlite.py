"""SQLite: one file in WAL mode, every commit on disk before it returns."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from sqlalchemy import event
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.ext.asyncio import AsyncConnection, create_async_engine

from magic_core.errors import CorruptData, DiskFull, MagicError
from magic_server.store.blobs import DISK_RETRY_S

# A full disk shows as either, depending on which file had to grow.
_NO_ROOM = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_SHMSIZE)

_DAMAGED = (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT)


class Sqlite:
    """One file, which one server has to itself."""

    shared = False

    def __init__(self, path: Path) -> None:
        self.place = str(path)
        self.pool = create_async_engine(f"sqlite+aiosqlite:///{path}", pool_size=4)
        event.listen(self.pool.sync_engine, "connect", _prepare_connection)

    async def lock_schema(self, connection: AsyncConnection) -> None:
        """Python begins no transaction for changes of tables by itself."""
        await connection.exec_driver_sql("BEGIN IMMEDIATE")

    async def freeze(self, connection: AsyncConnection) -> None:
        """Nothing to do: there is one writer at a time."""

    async def lock_name(self, connection: AsyncConnection, session: str) -> None:
        """Nothing to do: there is one writer at a time."""

    def error_of(self, error: Exception) -> MagicError | None:
        """DiskFull when the disk has no room, CorruptData when the file is no whole database."""
        code = getattr(getattr(error, "orig", None), "sqlite_errorcode", None)
        if isinstance(error, OperationalError) and code in _NO_ROOM:
            message = "the server's disk is full; try again once there is room"
            return DiskFull(message, retry_after_s=DISK_RETRY_S)
        # The low byte of a code says what is wrong, the others where it was noticed.
        if isinstance(error, DatabaseError) and code is not None and code & 0xFF in _DAMAGED:
            return CorruptData(
                f"{self.place} is damaged or no database ({error.orig}); restore the data folder "
                "from a backup, or choose another one"
            )
        return None


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
