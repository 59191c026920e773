"""Operations and global maps in the store."""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa
from magicslam.v1 import global_map_service_pb2 as map_pb
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import AlreadyExists, MagicError, NotFound, Overloaded, WrongState
from magic_core.wire import names, records
from magic_core.wire.convert import moment
from magic_server.store.database import Database
from magic_server.store.rows import MapFile, SessionRow
from magic_server.store.schema import agents, map_files, maps, operations, sessions, submaps


@dataclass(frozen=True, slots=True)
class OpenOperation:
    """An operation that is not done."""

    id: int
    session: str
    request: map_pb.BuildGlobalMapRequest


@dataclass(frozen=True, slots=True)
class NewMap:
    """A finished map whose files are in place."""

    component: str
    revision: int
    submaps: tuple[str, ...]
    gaussian_count: int
    files: dict[records.MapFormat, MapFile]


MERGE_RETRY_S = 10.0
"""How long callers are asked to wait for a merge to end."""
_UNFINISHED = ("PENDING", "RUNNING")


class MapTable:
    """Operations and what they made."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def begin(
        self,
        session: SessionRow,
        request: map_pb.BuildGlobalMapRequest,
        *,
        max_open: int,
        now: float,
    ) -> tuple[int, bool]:
        """The operation of a request, and whether it is new: a repeat finds the first one.

        Raises AlreadyExists when the request id was used to ask for another map, Overloaded when
        the session has `max_open` operations that are not done.
        """
        same = sa.select(operations.c.id, operations.c.request).where(
            operations.c.session_id == session.id, operations.c.request_id == request.request_id
        )
        async with self._database.write(session.id) as connection:
            found = (await connection.execute(same)).one_or_none()
            if found is not None:
                if map_pb.BuildGlobalMapRequest.FromString(found.request) != request:
                    raise AlreadyExists(
                        f"request_id {request.request_id!r} was used to build another map; "
                        "give each request an id of its own"
                    )
                return found.id, False
            await _require_place(connection, session, max_open)
            values = {
                "session_id": session.id,
                "request_id": request.request_id,
                "request": request.SerializeToString(),
                "state": "PENDING",
                "progress": 0.0,
                "stage": "waiting",
                "created_at": now,
                "updated_at": now,
            }
            added = await connection.execute(sa.insert(operations), values)
            key = added.inserted_primary_key
            assert key is not None  # the table has an integer primary key
            return int(key[0]), True

    async def advance(
        self, operation: int, *, state: str, progress: float, stage: str, now: float
    ) -> None:
        """Store how far an operation is."""
        values = {"state": state, "progress": progress, "stage": stage, "updated_at": now}
        async with self._database.write() as connection:
            await self._require_holder(connection, operation)
            await _update(connection, operation, values)

    async def fail(self, operation: int, error: MagicError, *, now: float) -> None:
        """Store why an operation failed."""
        values = {
            "state": "FAILED",
            "error_code": error.grpc_code,
            "error_reason": error.reason,
            "error_message": error.message,
            "updated_at": now,
        }
        async with self._database.write() as connection:
            await self._require_holder(connection, operation)
            await _update(connection, operation, values)

    async def succeed(
        self, operation: int, session: SessionRow, made: NewMap, *, now: float
    ) -> None:
        """Store a map and that its operation is done, in one transaction.

        WrongState when one of its sub-maps was deleted while they were merged.
        """
        row = {
            "session_id": session.id,
            "component": made.component,
            "revision": made.revision,
            "submaps": list(made.submaps),
            "gaussian_count": made.gaussian_count,
            "created_at": now,
        }
        async with self._database.write(session.id) as connection:
            await _require_submaps(connection, session, made.submaps)
            added = await connection.execute(sa.insert(maps), row)
            key = added.inserted_primary_key
            assert key is not None  # the table has an integer primary key
            files = [
                {"map_id": key[0], "format": kind, "sha256": f.sha256, "length": f.length}
                for kind, f in made.files.items()
            ]
            await connection.execute(sa.insert(map_files), files)
            done = {"state": "SUCCEEDED", "progress": 1.0, "stage": "done"}
            values = done | {"map_id": key[0], "updated_at": now}
            await _update(connection, operation, values)

    async def _require_holder(self, connection: AsyncConnection, operation: int) -> None:
        query = sa.select(operations.c.session_id).where(operations.c.id == operation)
        if (session := await connection.scalar(query)) is not None:
            await self._database.require(connection, session)

    async def unfinished(self) -> list[OpenOperation]:
        """Every operation that is not done, oldest first."""
        query = sa.select(operations.c.id, operations.c.request, sessions.c.name).join(sessions)
        query = query.where(operations.c.state.in_(_UNFINISHED))
        query = query.order_by(operations.c.id)
        async with self._database.read() as connection:
            rows = (await connection.execute(query)).all()
        parse = map_pb.BuildGlobalMapRequest.FromString
        return [OpenOperation(row.id, row.name, parse(row.request)) for row in rows]

    async def operation(self, session: str, operation: str) -> records.OperationStatus:
        """An operation; NotFound when there is none of that name."""
        query = _OPERATIONS.where(sessions.c.name == session, operations.c.id == _number(operation))
        async with self._database.read() as connection:
            row = (await connection.execute(query)).one_or_none()
        if row is None:
            raise NotFound(f"{names.operation_name(session, operation)} does not exist")
        return _status(row)

    async def operation_page(
        self, session: SessionRow, *, after: int = 0, limit: int = 100
    ) -> tuple[list[records.OperationStatus], int | None]:
        """Operations behind row id `after`, and where the next page begins."""
        query = _OPERATIONS.where(sessions.c.id == session.id, operations.c.id > after)
        async with self._database.read() as connection:
            found = await connection.execute(query.order_by(operations.c.id).limit(limit + 1))
            rows = found.all()
        following = rows[limit - 1].id if len(rows) > limit else None
        return [_status(row) for row in rows[:limit]], following

    async def map_file(
        self, session: str, map_id: str | None, kind: records.MapFormat
    ) -> tuple[records.GlobalMapInfo, MapFile]:
        """A map, the newest where no id is given, and one of its files; NotFound without one."""
        query = (
            sa.select(maps, map_files.c.sha256, map_files.c.length)
            .join(map_files)
            .join(sessions)
            .where(sessions.c.name == session, map_files.c.format == kind)
        )
        if map_id is not None:
            query = query.where(maps.c.id == _number(map_id))
        query = query.order_by(maps.c.id.desc()).limit(1)
        async with self._database.read() as connection:
            row = (await connection.execute(query)).one_or_none()
        if row is None:
            name = names.map_name(session, map_id) if map_id else f"a map of sessions/{session}"
            raise NotFound(f"{name} does not exist; call BuildGlobalMap first")
        info = _map_info(session, row)
        return info, MapFile(row.sha256, row.length)


_OPERATIONS = (
    sa.select(
        operations,
        sessions.c.name.label("session"),
        maps.c.component,
        maps.c.revision,
        maps.c.submaps,
        maps.c.gaussian_count,
        maps.c.created_at.label("map_created_at"),
    )
    .select_from(operations)
    .join(sessions, sessions.c.id == operations.c.session_id)
    .outerjoin(maps, maps.c.id == operations.c.map_id)
)


async def _require_place(connection: AsyncConnection, session: SessionRow, max_open: int) -> None:
    unfinished = sa.select(sa.func.count()).where(
        operations.c.session_id == session.id, operations.c.state.in_(_UNFINISHED)
    )
    count = await connection.scalar(unfinished) or 0
    if count >= max_open:
        raise Overloaded(
            f"{names.session_name(session.name)} has {count} merges that are not done, this server "
            f"keeps {max_open}; wait for one",
            retry_after_s=MERGE_RETRY_S,
        )


async def _require_submaps(
    connection: AsyncConnection, session: SessionRow, wanted: tuple[str, ...]
) -> None:
    query = sa.select(agents.c.name, submaps.c.number).join(agents)
    rows = await connection.execute(query.where(submaps.c.session_id == session.id))
    stored = {names.submap_name(session.name, row.name, row.number) for row in rows}
    if missing := [name for name in wanted if name not in stored]:
        raise WrongState(f"{missing[0]} was deleted while it was merged; build the map again")


async def _update(connection: AsyncConnection, operation: int, values: dict[str, object]) -> None:
    await connection.execute(
        sa.update(operations).where(operations.c.id == operation).values(values)
    )


def _number(name: str) -> int:
    """The row id that an operation's or a map's id is; -1, which none has, for anything else."""
    return int(name) if name.isascii() and name.isdigit() and len(name) < 18 else -1


def _status(row: sa.Row) -> records.OperationStatus:
    error, result = None, None
    if row.error_code is not None:
        error = records.OperationError(row.error_code, row.error_reason, row.error_message)
    if row.map_id is not None:
        result = records.GlobalMapInfo(
            name=names.map_name(row.session, str(row.map_id)),
            component=row.component,
            revision=row.revision,
            submaps=tuple(row.submaps),
            gaussian_count=row.gaussian_count,
            created_at=moment(row.map_created_at),
        )
    return records.OperationStatus(
        name=names.operation_name(row.session, str(row.id)),
        state=row.state,
        progress=row.progress,
        stage=row.stage,
        created_at=moment(row.created_at),
        updated_at=moment(row.updated_at),
        error=error,
        result=result,
    )


def _map_info(session: str, row: sa.Row) -> records.GlobalMapInfo:
    return records.GlobalMapInfo(
        name=names.map_name(session, str(row.id)),
        component=row.component,
        revision=row.revision,
        submaps=tuple(row.submaps),
        gaussian_count=row.gaussian_count,
        created_at=moment(row.created_at),
    )
