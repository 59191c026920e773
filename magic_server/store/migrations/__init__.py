"""Revisions of the tables, and how a database comes to the newest one.

A new database begins at the newest; an older one goes through the revisions under `versions`.
"""

from __future__ import annotations

import logging

import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import WrongState
from magic_server.store import schema

logger = logging.getLogger(__name__)

HEAD = "0005"
"""The revision of this build."""
FIRST = "0001"
"""What databases from before the revisions are at."""

_version = sa.Table(
    "alembic_version", sa.MetaData(), sa.Column("version_num", sa.String(32), primary_key=True)
)


async def upgrade(connection: AsyncConnection, place: str) -> None:
    """Bring a database to this build's revision.

    WrongState for one of a later build, or one that is not ours. Nothing is changed then.
    """
    found = await connection.run_sync(_found)
    if found is None:
        await connection.run_sync(_begin)
        return
    if found > HEAD:
        raise WrongState(
            f"{place} has schema version {found}, this build knows {HEAD}; use the version of "
            "magic-slam that wrote it, or a later one"
        )
    if found != HEAD:  # Alembic is loaded only then: it takes a quarter of a second
        logger.info("%s: schema version %s becomes %s", place, found, HEAD)
        await connection.run_sync(_upgrade, found)
    if missing := await connection.run_sync(_missing):
        raise WrongState(
            f"{place} has schema version {found} without {', '.join(missing)}: it was changed by "
            "something else than magic-slam; restore it from a backup, or export its sessions "
            "with the version that wrote it (`magic sessions export`) and import them into another "
            "data folder"
        )


def _found(connection: sa.Connection) -> str | None:
    """The revision of a database; None for an empty one."""
    tables = set(sa.inspect(connection).get_table_names())
    if _version.name in tables:
        return connection.scalar(sa.select(_version.c.version_num))
    return FIRST if schema.sessions.name in tables else None


def _missing(connection: sa.Connection) -> list[str]:
    """Tables and columns that this build needs and the database has not."""
    ours = list(schema.metadata.tables)
    tables = sa.inspect(connection).get_multi_columns(filter_names=ours)
    found = {
        table: {column["name"] for column in columns} for (_, table), columns in tables.items()
    }
    missing = []
    for table in schema.metadata.sorted_tables:
        if table.name not in found:
            missing.append(f"table {table.name}")
            continue
        gone = [column.name for column in table.c if column.name not in found[table.name]]
        missing += [f"column {table.name}.{name}" for name in gone]
    return missing


def _begin(connection: sa.Connection) -> None:
    """Every table as it is now."""
    schema.metadata.create_all(connection)
    _version.create(connection)
    version = {"version": schema.SCHEMA_VERSION}
    connection.execute(sa.insert(schema.schema_version), version)
    connection.execute(sa.insert(_version), {"version_num": HEAD})


def _upgrade(connection: sa.Connection, found: str) -> None:
    logging.getLogger("alembic").setLevel(logging.WARNING)  # a page of steps behind our one line
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", "magic_server.store:migrations")
    config.attributes["connection"] = connection
    if not sa.inspect(connection).has_table(_version.name):
        command.stamp(config, found)
    command.upgrade(config, HEAD)
