"""Keeps adding blobs apart from removing them: a blob must not go while a transaction comes to
rely on it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import sqlalchemy as sa

from magic_server.store.database import Database

BLOB_LOCK = 0x626C6F62  # "blob": the number of an advisory lock


class CommitLock:
    """The lock of a server that has its blob folder to itself.

    async with lock:           adopt blobs and refer to them in a transaction
    async with lock.alone():   find blobs that nothing refers to and remove them
    """

    def __init__(self) -> None:
        self._lock = asyncio.Lock()

    async def __aenter__(self) -> None:
        await self._lock.acquire()

    async def __aexit__(self, *_: object) -> None:
        self._lock.release()

    @asynccontextmanager
    async def alone(self) -> AsyncIterator[None]:
        """Nobody adds and nobody removes meanwhile."""
        async with self._lock:
            yield


class SharedCommitLock(CommitLock):
    """The lock of servers that share a blob folder: many add at once, one removes alone.

    It is a lock of the database, which lets go of it when a server dies.
    """

    def __init__(self, database: Database) -> None:
        super().__init__()
        self._database = database
        self._held: AsyncExitStack | None = None

    async def __aenter__(self) -> None:
        await super().__aenter__()
        try:
            async with AsyncExitStack() as stack:
                lock = sa.func.pg_advisory_xact_lock_shared(BLOB_LOCK)
                await stack.enter_async_context(self._transaction(lock))
                self._held = stack.pop_all()
        except BaseException:
            await super().__aexit__()
            raise

    async def __aexit__(self, *_: object) -> None:
        held, self._held = self._held, None
        try:
            if held is not None:
                await held.aclose()
        finally:
            await super().__aexit__()

    @asynccontextmanager
    async def alone(self) -> AsyncIterator[None]:
        """No server adds and none removes meanwhile."""
        async with self._lock, self._transaction(sa.func.pg_advisory_xact_lock(BLOB_LOCK)):
            yield

    @asynccontextmanager
    async def _transaction(self, lock: sa.Function) -> AsyncIterator[None]:
        async with self._database.write() as connection:
            await connection.execute(sa.select(lock))
            yield
