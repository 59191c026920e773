"""Revisions of the tables, and how a database comes to the newest one.

A new database begins at the newest; an older one goes through the revisions under `versions`.
"""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import WrongState
from magic_server.store import schema

HEAD = "0002"
"""The revision of this build."""
FIRST = "0001"
"""What databases from before the revisions are at."""

_version = sa.Table(
    "alembic_version", sa.MetaData(), sa.Column("version_num", sa.String(32), primary_key=True)
)


async def upgrade(connection: AsyncConnection, place: str) -> None:
    """Bring a database to this build's revision; WrongState for one of a later build."""
    found = await connection.run_sync(_found)
    if found == HEAD:
        return  # without loading Alembic, which takes a quarter of a second
    if found is None:
        await connection.run_sync(_begin)
        return
    if found > HEAD:
        raise WrongState(
            f"{place} has schema version {found}, this build knows {HEAD}; use the version of "
            "magic-slam that wrote it, or a later one"
        )
    await connection.run_sync(_upgrade, found)


def _found(connection: sa.Connection) -> str | None:
    """The revision of a database; None for an empty one."""
    tables = set(sa.inspect(connection).get_table_names())
    if _version.name in tables:
        return connection.scalar(sa.select(_version.c.version_num))
    return FIRST if schema.sessions.name in tables else None


def _begin(connection: sa.Connection) -> None:
    """Every table as it is now."""
    schema.metadata.create_all(connection)
    _version.create(connection)
    version = {"version": schema.SCHEMA_VERSION}
    connection.execute(sa.insert(schema.schema_version), version)
    connection.execute(sa.insert(_version), {"version_num": HEAD})


def _upgrade(connection: sa.Connection, found: str) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "magic_server.store:migrations")
    config.attributes["connection"] = connection
    if not sa.inspect(connection).has_table(_version.name):
        command.stamp(config, found)
    command.upgrade(config, HEAD)
