"""The database: transactions on whichever engine the store has."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Protocol

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_server.store import migrations
from magic_server.store.engines import Engine


class Fence(Protocol):
    """Keeps writes about a session with the server that holds it."""

    async def add(self, connection: AsyncConnection, session: int) -> None:
        """This server holds a session that begins in this transaction."""
        ...

    async def require(self, connection: AsyncConnection, session: int) -> None:
        """Raise unless this server holds the session, and see that it does until the commit."""
        ...


class Database:
    """Connections to the store's database; one writer at a time, many readers.

    Where several servers share it a session has one writer at a time.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.fence: Fence | None = None
        self._write_lock = contextlib.nullcontext() if engine.shared else asyncio.Lock()

    async def open(self, *, first: Callable[[AsyncConnection], Awaitable[None]]) -> None:
        """Bring the tables to what this build knows, and do something `first` with them.

        WrongState for tables of a later build.
        """
        with self._translated():
            async with self.engine.pool.begin() as connection:
                await self.engine.lock_schema(connection)
                await migrations.upgrade(connection, self.engine.place)
                await first(connection)

    async def close(self) -> None:
        """Close every connection."""
        await self.engine.pool.dispose()

    @asynccontextmanager
    async def read(self) -> AsyncIterator[AsyncConnection]:
        """A connection for reading."""
        with self._translated():
            async with self.engine.pool.connect() as connection:
                yield connection

    @asynccontextmanager
    async def write(self, *sessions: int) -> AsyncIterator[AsyncConnection]:
        """One transaction: durable when the block ends, undone when it raises.

        `sessions` are the row ids of those it is about: HeldElsewhere where another server has
        one of them. Raises DiskFull when the disk has no room for it.
        """
        with self._translated():
            async with self._write_lock, self.engine.pool.begin() as connection:
                for session in sorted(sessions):  # in one order: nobody waits in a circle
                    await self.require(connection, session)
                yield connection

    async def require(self, connection: AsyncConnection, session: int) -> None:
        """Within a transaction: raise unless this server may write about a session."""
        if self.fence is not None:
            await self.fence.require(connection, session)

    async def freeze(self, connection: AsyncConnection) -> None:
        """At the start of a transaction: its queries all see the same instant."""
        await self.engine.freeze(connection)

    async def lock_name(self, connection: AsyncConnection, session: str) -> None:
        """Within a transaction: nobody else begins a session of this name meanwhile."""
        await self.engine.lock_name(connection, session)

    async def began(self, connection: AsyncConnection, session: int) -> None:
        """Within the transaction that begins a session: this server has it."""
        if self.fence is not None:
            await self.fence.add(connection, session)

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except (SQLAlchemyError, OSError) as error:
            if (meaning := self.engine.error_of(error)) is not None:
                raise meaning from error
            raise
