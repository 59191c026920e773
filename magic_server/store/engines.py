"""The engines that a store's database may run on, and what they have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import GenericFunction

from magic_core.errors import MagicError
from magic_server.store_config import StoreConfig


class Engine(Protocol):
    """One kind of database."""

    place: str
    """Where it is, as people may read it: without a password."""
    shared: bool
    """Whether several servers may use it at once."""
    pool: AsyncEngine

    async def lock_schema(self, connection: AsyncConnection) -> None:
        """Let nobody else change the tables until the transaction ends."""
        ...

    async def freeze(self, connection: AsyncConnection) -> None:
        """At the start of a transaction: its queries all see the same instant."""
        ...

    async def lock_name(self, connection: AsyncConnection, session: str) -> None:
        """Let nobody else begin a session of this name until the transaction ends."""
        ...

    def error_of(self, error: Exception) -> MagicError | None:
        """What an error of the driver means to callers; None for one that is our fault."""
        ...


def engine_of(config: StoreConfig, folder: Path) -> Engine:
    """The engine that the settings name; ConfigError for an address that is none."""
    address = config.address()
    if address:
        from magic_server.store.postgresql import PostgreSql

        return PostgreSql(address, config)
    from magic_server.store.sqlite import Sqlite

    return Sqlite(folder / "magic.sqlite")


class greatest(GenericFunction):  # noqa: N801  # functions of SQL are written like this
    """The largest of its arguments."""

    type = sa.BigInteger()
    inherit_cache = True


@compiles(greatest, "sqlite")
def _greatest_of_sqlite(element: greatest, compiler: Any, **options: Any) -> str:
    return f"max{compiler.process(element.clause_expr, **options)}"


def total(column: sa.Column) -> sa.ColumnElement[int]:
    """The sum of whole numbers, as one: PostgreSQL makes a decimal of it. 0 without any."""
    return sa.cast(sa.func.coalesce(sa.func.sum(column), 0), sa.BigInteger)
