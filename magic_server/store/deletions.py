"""Deleting sub-maps, agents and sessions: one transaction, then the files that nobody needs."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import NotFound, Unavailable
from magic_server.store.blob_store import BlobStore
from magic_server.store.commit_lock import CommitLock
from magic_server.store.database import Database
from magic_server.store.rows import AgentRow, SessionRow
from magic_server.store.schema import (
    agents,
    deletions,
    loops,
    map_files,
    maps,
    metadata,
    operations,
    removed_submaps,
    sessions,
    snapshot_changes,
    snapshots,
    submap_blobs,
    submaps,
)

logger = logging.getLogger(__name__)

_BATCH = 500
REMEMBERED_S = 30 * 86400.0
"""First answers of deletions are kept this long."""


@dataclass(frozen=True, slots=True)
class DeletionRequest:
    """Who asked to delete what, and when."""

    name: str
    """Resource name."""
    request_id: str
    now: float


@dataclass(frozen=True, slots=True)
class Deleted:
    """What a request deleted."""

    submap_count: int
    freed_bytes: int


@dataclass(frozen=True, slots=True)
class NewSolution:
    """The solution that takes the place of one with deleted sub-maps in it."""

    revision: int
    snapshot: bytes


class Deletions:
    """Takes things out of the store; nothing else can be added meanwhile."""

    def __init__(
        self, database: Database, blobs: BlobStore, *, lock: CommitLock, threads: Executor
    ) -> None:
        self._database = database
        self._blobs = blobs
        self._lock = lock
        self._threads = threads

    async def first_answer(self, name: str, request_id: str) -> Deleted | None:
        """What an earlier request with this id deleted, or None."""
        query = sa.select(deletions.c.submap_count, deletions.c.freed_bytes).where(
            deletions.c.name == name, deletions.c.request_id == request_id
        )
        async with self._database.read() as connection:
            row = (await connection.execute(query)).one_or_none()
        return None if row is None else Deleted(*row)

    async def submap(
        self, agent: AgentRow, index: int, request: DeletionRequest, solution: NewSolution | None
    ) -> Deleted:
        """Delete one sub-map; what its neighbours need of it is kept."""
        which = sa.and_(submaps.c.agent_id == agent.id, submaps.c.number == index)
        async with self._lock.alone():
            async with self._database.write(agent.session.id) as connection:
                digests = await _blobs_of(connection, which)
                if not digests:
                    raise NotFound(f"{request.name} is not stored")
                await connection.execute(_keep_in_mind(which))
                digests += await _without_maps(connection, agent.session, request.name)
                await _forget_loops(connection, agent.session, (loops.c.source, request.name))
                await _forget_loops(connection, agent.session, (loops.c.target, request.name))
                await _replace_solution(connection, agent.session, solution)
                await _drop_submaps(connection, which)
                deleted, orphans = await self._answer(connection, request, 1, digests)
            await self._remove(orphans)
        return deleted

    async def agent(
        self, agent: AgentRow, request: DeletionRequest, solution: NewSolution | None
    ) -> Deleted:
        """Delete an agent with all of its sub-maps; its name is free again."""
        which = submaps.c.agent_id == agent.id
        async with self._lock.alone():
            async with self._database.write(agent.session.id) as connection:
                if not await _exists(connection, agent):
                    raise NotFound(f"{request.name} does not exist")
                count = await _count(connection, which)
                digests = await _blobs_of(connection, which)
                prefix = f"{request.name}/"
                digests += await _without_maps(connection, agent.session, prefix)
                await _forget_loops(connection, agent.session, (loops.c.source, prefix))
                await _forget_loops(connection, agent.session, (loops.c.target, prefix))
                await _replace_solution(connection, agent.session, solution)
                await _drop_submaps(connection, which)
                await _drop_rows(connection, {"agent_id": agent.id})
                await connection.execute(sa.delete(agents).where(agents.c.id == agent.id))
                deleted, orphans = await self._answer(connection, request, count, digests)
            await self._remove(orphans)
        return deleted

    async def session(self, session: SessionRow, request: DeletionRequest) -> Deleted:
        """Delete a session with all it holds; its name is free again."""
        which = submaps.c.session_id == session.id
        async with self._lock.alone():
            async with self._database.write(session.id) as connection:
                count = await _count(connection, which)
                digests = await _blobs_of(connection, which)
                mine = sa.select(maps.c.id).where(maps.c.session_id == session.id)
                digests += await _map_blobs(connection, mine)
                await connection.execute(sa.delete(map_files).where(map_files.c.map_id.in_(mine)))
                await _drop_submaps(connection, which)
                members = sa.select(agents.c.id).where(agents.c.session_id == session.id)
                await _drop_rows(connection, {"session_id": session.id, "agent_id": members})
                await connection.execute(sa.delete(sessions).where(sessions.c.id == session.id))
                deleted, orphans = await self._answer(connection, request, count, digests)
            await self._remove(orphans)
        return deleted

    async def _answer(
        self,
        connection: AsyncConnection,
        request: DeletionRequest,
        count: int,
        digests: Sequence[str],
    ) -> tuple[Deleted, list[str]]:
        """Remember the answer; returns it with the blobs that nothing refers to any more."""
        orphans = await _unused(connection, sorted(set(digests)))
        loop = asyncio.get_running_loop()
        freed = await loop.run_in_executor(self._threads, self._blobs.total_bytes, orphans)
        old = deletions.c.deleted_at < request.now - REMEMBERED_S
        await connection.execute(sa.delete(deletions).where(old))
        row = {
            "name": request.name,
            "request_id": request.request_id,
            "submap_count": count,
            "freed_bytes": freed,
            "deleted_at": request.now,
        }
        await connection.execute(sa.insert(deletions), row)
        return Deleted(count, freed), orphans

    async def _remove(self, orphans: list[str]) -> None:
        # A server that dies here leaves files that nothing refers to; its next start removes them.
        loop = asyncio.get_running_loop()
        try:
            await asyncio.shield(loop.run_in_executor(self._threads, self._blobs.remove, orphans))
        except Unavailable as error:  # what was deleted is deleted
            logger.warning("%d deleted blobs are removed later: %s", len(orphans), error)


async def _unused(connection: AsyncConnection, digests: Sequence[str]) -> list[str]:
    """Those that no sub-map and no map refers to."""
    used: set[str] = set()
    for begin in range(0, len(digests), _BATCH):
        batch = digests[begin : begin + _BATCH]
        for column in (submap_blobs.c.sha256, map_files.c.sha256):
            used.update(await connection.scalars(sa.select(column).where(column.in_(batch))))
    return [digest for digest in digests if digest not in used]


def _keep_in_mind(which: sa.ColumnElement[bool]) -> sa.Insert:
    """Copies into `removed_submaps` what is still needed of sub-maps."""
    columns = [column.name for column in removed_submaps.c]
    return sa.insert(removed_submaps).from_select(
        columns, sa.select(*(submaps.c[name] for name in columns)).where(which)
    )


async def _exists(connection: AsyncConnection, agent: AgentRow) -> bool:
    return bool(await connection.scalar(sa.select(agents.c.id).where(agents.c.id == agent.id)))


async def _count(connection: AsyncConnection, which: sa.ColumnElement[bool]) -> int:
    query = sa.select(sa.func.count()).select_from(submaps).where(which)
    return await connection.scalar(query) or 0


async def _blobs_of(connection: AsyncConnection, which: sa.ColumnElement[bool]) -> list[str]:
    query = sa.select(submap_blobs.c.sha256).join(submaps).where(which)
    return list(await connection.scalars(query))


async def _map_blobs(connection: AsyncConnection, chosen: sa.Select) -> list[str]:
    query = sa.select(map_files.c.sha256).where(map_files.c.map_id.in_(chosen))
    return list(await connection.scalars(query))


async def _without_maps(
    connection: AsyncConnection, session: SessionRow, deleted: str
) -> list[str]:
    """Delete the maps that a deleted sub-map is in; returns their blobs.

    `deleted` is a resource name, or the beginning of several up to and with a slash.
    """
    rows = await connection.execute(
        sa.select(maps.c.id, maps.c.submaps).where(maps.c.session_id == session.id)
    )
    digests: list[str] = []
    for row in rows.all():
        if not any(_is(name, deleted) for name in row.submaps):
            continue
        digests += await _map_blobs(connection, sa.select(sa.literal(row.id)))
        message = f"its map was deleted with {deleted.rstrip('/')}; build it again"
        gone = {"state": "FAILED", "map_id": None, "error_code": "NOT_FOUND"}
        gone |= {"error_reason": NotFound.reason, "error_message": message}
        await connection.execute(
            sa.update(operations).where(operations.c.map_id == row.id).values(gone)
        )
        await connection.execute(sa.delete(map_files).where(map_files.c.map_id == row.id))
        await connection.execute(sa.delete(maps).where(maps.c.id == row.id))
    return digests


def _is(name: str, deleted: str) -> bool:
    return name.startswith(deleted) if deleted.endswith("/") else name == deleted


async def _forget_loops(
    connection: AsyncConnection, session: SessionRow, end: tuple[sa.Column, str]
) -> None:
    column, deleted = end
    chosen = column == deleted
    if deleted.endswith("/"):
        chosen = sa.func.substr(column, 1, len(deleted)) == deleted
    await connection.execute(sa.delete(loops).where(loops.c.session_id == session.id, chosen))


async def _replace_solution(
    connection: AsyncConnection, session: SessionRow, solution: NewSolution | None
) -> None:
    if solution is not None:
        change = sa.update(snapshots).where(snapshots.c.session_id == session.id)
        values = {"revision": solution.revision, "snapshot": solution.snapshot}
        values["settled"] = False
        await connection.execute(change.values(values))
        old = sa.delete(snapshot_changes)
        await connection.execute(old.where(snapshot_changes.c.session_id == session.id))


async def _drop_submaps(connection: AsyncConnection, which: sa.ColumnElement[bool]) -> None:
    chosen = sa.select(submaps.c.id).where(which)
    await _drop_rows(connection, {"submap_id": chosen})
    await connection.execute(sa.delete(submaps).where(which))


async def _drop_rows(connection: AsyncConnection, owners: dict[str, int | sa.Select]) -> None:
    """Delete the rows of every table that belong to one of these owners, dependants first."""
    for table in reversed(metadata.sorted_tables):
        for column, owner in owners.items():
            if column in table.c:
                mine = table.c[column].in_(owner if isinstance(owner, sa.Select) else [owner])
                await connection.execute(sa.delete(table).where(mine))
