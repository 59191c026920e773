"""PostgreSQL: a server that several of ours may share. Needs the `cluster` extra."""

from __future__ import annotations

import socket

import sqlalchemy as sa
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.ext.asyncio import AsyncConnection, create_async_engine

from magic_core.errors import ConfigError, DiskFull, MagicError, Unavailable
from magic_server.store.blobs import DISK_RETRY_S
from magic_server.store_config import EXAMPLE, StoreConfig

RETRY_S = 1.0
"""How long callers are asked to wait while the database is away."""
SCHEMA_LOCK = 0x6D61676963  # "magic": the number of an advisory lock
NAME_LOCKS = 0x6E616D65  # seed of the numbers of the locks of names
_DRIVER = "postgresql+asyncpg"
_ALIASES = ("postgres", "postgresql", _DRIVER)
# SQLSTATE classes: connection, operator's intervention, too many connections, lost serialisation.
_PASSING = ("08", "57P", "53300", "40")
_NO_ROOM = "53100"
_AWAY = (ConnectionError, TimeoutError, socket.gaierror, PoolTimeout)


class PostgreSql:
    """A database on a PostgreSQL server."""

    shared = True

    def __init__(self, address: str, config: StoreConfig) -> None:
        url = _url(address)
        self.place = url.render_as_string(hide_password=True)
        self._name = url.database
        self._user = url.username
        try:
            self.pool = create_async_engine(
                url,
                pool_size=config.connections,
                max_overflow=0,
                pool_timeout=30.0,
                pool_pre_ping=True,  # a database that was started again is noticed without a loss
                hide_parameters=True,
                # A server that dies without a word must not hold locks for hours.
                connect_args={
                    "timeout": config.connect_timeout_s,
                    "command_timeout": 60.0,
                    "server_settings": {
                        "application_name": "magic-slam",
                        "idle_in_transaction_session_timeout": "60000",
                        "tcp_keepalives_idle": "5",
                        "tcp_keepalives_interval": "2",
                        "tcp_keepalives_count": "3",
                    },
                },
            )
        except ModuleNotFoundError as error:
            raise ConfigError.field(
                "store.database",
                f"PostgreSQL needs the package {error.name}: pip install 'magic-slam[cluster]'",
            ) from error

    async def lock_schema(self, connection: AsyncConnection) -> None:
        """Servers that start together change the tables one after the other."""
        await connection.execute(sa.select(sa.func.pg_advisory_xact_lock(SCHEMA_LOCK)))

    async def freeze(self, connection: AsyncConnection) -> None:
        """What other transactions commit meanwhile is not seen."""
        await connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")

    async def lock_name(self, connection: AsyncConnection, session: str) -> None:
        """Two agents that begin a session at once enter the same one."""
        number = sa.func.hashtextextended(session, NAME_LOCKS)
        await connection.execute(sa.select(sa.func.pg_advisory_xact_lock(number)))

    def error_of(self, error: Exception) -> MagicError | None:
        """ConfigError for what the operator must change, Unavailable for what may pass."""
        found = error.orig if isinstance(error, DBAPIError) and error.orig else error
        state = getattr(found, "sqlstate", None) or getattr(found, "pgcode", None) or ""
        if state == _NO_ROOM:
            message = "the disk of the database is full; try again once there is room"
            return DiskFull(message, retry_after_s=DISK_RETRY_S)
        if remedy := self._remedies().get(state):
            return ConfigError.field(
                "store.database", f"{self.place}: {_first_line(found)}; {remedy}"
            )
        broken = isinstance(error, DBAPIError) and error.connection_invalidated
        away = isinstance(found, _AWAY) or broken
        if away or state.startswith(_PASSING):
            return Unavailable(
                f"the database at {self.place} is away ({_first_line(found)}); is it running, and "
                "may this machine reach it?",
                retry_after_s=RETRY_S,
            )
        return None

    def _remedies(self) -> dict[str, str]:
        """What to do, by SQLSTATE."""
        user, name = self._user or "its user", self._name
        password = f"check name and password of {user}, and pg_hba.conf on the database server"
        return {
            "28P01": password,
            "28000": password,
            "3D000": f"create it: createdb --owner={user} {name}",
            "42501": f"give {user} its rights: ALTER DATABASE {name} OWNER TO {user}",
            "25006": "it is a standby that only reads; give the address of the primary",
        }


def _url(address: str) -> URL:
    """The address as a URL; ConfigError, which does not repeat a password, for anything else."""
    try:
        url = make_url(address)
    except (ArgumentError, ValueError) as error:
        raise ConfigError.field(
            "store.database", f"not the address of a database; expected {EXAMPLE}"
        ) from error
    if url.drivername not in _ALIASES:
        raise ConfigError.field(
            "store.database",
            f"{url.drivername}: expected {EXAMPLE}, or nothing for SQLite in the data folder",
        )
    if not url.database:
        raise ConfigError.field(
            "store.database",
            f"{url.render_as_string(hide_password=True)} names no database; expected {EXAMPLE}",
        )
    return url.set(drivername=_DRIVER)


def _first_line(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    line = text[0] if text else type(error).__name__
    return line.removeprefix("<class 'asyncpg.exceptions.").replace("'>:", ":")
