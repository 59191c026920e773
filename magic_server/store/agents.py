"""Sessions and agents in the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import DescriptorModelMismatch, NotFound, WrongState
from magic_core.wire import names, records
from magic_core.wire.convert import moment
from magic_server.store import answers
from magic_server.store.answers import Asked
from magic_server.store.database import Database
from magic_server.store.engines import greatest, total
from magic_server.store.rows import AgentRow, SessionRow
from magic_server.store.schema import agents, loops, removed_submaps, sessions, snapshots, submaps


@dataclass(frozen=True, slots=True)
class Registration:
    """What an agent is told when it enters a session."""

    agent: AgentRow
    resumed: bool
    """It was there before."""
    next_submap_index: int
    revision: int
    """Of the session's pose graph."""


class AgentTable:
    """Sessions and their agents."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def register(
        self, session: str, agent: str, *, model_id: str, dimension: int, asked: Asked
    ) -> Registration:
        """Enter an agent into a session; a repeat of the request gets the first answer.

        Raises DescriptorModelMismatch when the session is pinned to another encoder, WrongState
        when the agent has finished, AlreadyExists when the request id was used for another request.
        """
        async with self._database.write() as connection:
            pinned = await self._pinned_session(
                connection, session, model_id=model_id, dimension=dimension, now=asked.now
            )
            found = await _find_agent(connection, pinned, agent)
            resumed = found is not None
            if found is None:
                values = {"session_id": pinned.id, "name": agent, "finished": False}
                values |= {"registered_at": asked.now, "last_seen_at": asked.now}
                added = await connection.execute(sa.insert(agents), values)
                found = AgentRow(_new_id(added), pinned, agent, False)
            elif (first := await answers.first_answer(connection, found.id, asked)) is not None:
                return Registration(found, **first)
            if found.finished:
                name = names.agent_name(session, agent)
                raise WrongState(f"{name} has finished; register under another agent name")
            await _touch(connection, found.id, asked.now)
            revision = sa.select(snapshots.c.revision).where(snapshots.c.session_id == pinned.id)
            answer = {
                "resumed": resumed,
                "next_submap_index": await _next_submap_index(connection, found.id),
                "revision": await connection.scalar(revision) or 0,
            }
            await answers.remember(connection, found.id, asked, answer)
            return Registration(found, **answer)

    async def finish(self, session: str, agent: str, *, asked: Asked) -> int:
        """Mark an agent as done; returns its number of sub-maps. A repeat gets the first answer."""
        found = await self.agent(session, agent)
        async with self._database.write(found.session.id) as connection:
            if (first := await answers.first_answer(connection, found.id, asked)) is not None:
                return first["submap_count"]
            change = sa.update(agents).where(agents.c.id == found.id)
            await connection.execute(change.values(finished=True, last_seen_at=asked.now))
            count = sa.select(sa.func.count()).where(submaps.c.agent_id == found.id)
            answer = {"submap_count": await connection.scalar(count) or 0}
            await answers.remember(connection, found.id, asked, answer)
            return answer["submap_count"]

    async def session(self, session: str) -> SessionRow:
        """A session; NotFound when there is none of that name."""
        found = await self.find(session)
        if found is None:
            raise NotFound(f"{names.session_name(session)} does not exist; register an agent first")
        return found

    async def find(self, session: str) -> SessionRow | None:
        """A session, or None when there is none of that name."""
        async with self._database.read() as connection:
            return await _find_session(connection, session)

    async def agent(self, session: str, agent: str) -> AgentRow:
        """An agent; NotFound when there is none of that name."""
        row = await self.session(session)
        async with self._database.read() as connection:
            found = await _find_agent(connection, row, agent)
        if found is None:
            raise NotFound(f"{names.agent_name(session, agent)} does not exist; register it first")
        return found

    async def active(self, session: SessionRow) -> list[str]:
        """The ids of a session's agents that have not finished, oldest first."""
        query = sa.select(agents.c.name).where(
            agents.c.session_id == session.id, sa.not_(agents.c.finished)
        )
        async with self._database.read() as connection:
            return list(await connection.scalars(query.order_by(agents.c.id)))

    async def sessions(self) -> list[SessionRow]:
        """Every session, oldest first."""
        async with self._database.read() as connection:
            rows = await connection.execute(sa.select(sessions).order_by(sessions.c.id))
            return [SessionRow(r.id, r.name, r.model_id, r.dimension) for r in rows]

    async def session_page(
        self, *, after: int = 0, limit: int = 100, session: str | None = None
    ) -> tuple[list[records.SessionInfo], int | None]:
        """Sessions behind row id `after`, or the one of a name, and where the next page begins."""
        query = _session_infos().where(sessions.c.id > after)
        if session is not None:
            query = query.where(sessions.c.name == session)
        rows, following = await self._page(query.order_by(sessions.c.id), limit)
        return [_session_info(row) for row in rows], following

    async def agent_page(
        self, session: SessionRow, *, after: int = 0, limit: int = 100, agent: str | None = None
    ) -> tuple[list[records.AgentInfo], int | None]:
        """Agents behind row id `after`, or the one of a name, and where the next page begins."""
        mine = submaps.c.agent_id == agents.c.id
        query = sa.select(
            agents,
            sa.select(sa.func.count()).where(mine).scalar_subquery().label("submap_count"),
            _last_number(agents.c.id).label("last"),
        ).where(agents.c.session_id == session.id, agents.c.id > after)
        if agent is not None:
            query = query.where(agents.c.name == agent)
        rows, following = await self._page(query.order_by(agents.c.id), limit)
        return [_agent_info(session.name, row) for row in rows], following

    async def _pinned_session(
        self,
        connection: AsyncConnection,
        session: str,
        *,
        model_id: str,
        dimension: int,
        now: float,
    ) -> SessionRow:
        """The session, begun with this encoder where it is new."""
        await self._database.lock_name(connection, session)
        found = await _find_session(connection, session)
        if found is not None:
            await self._database.require(connection, found.id)
            require_model(found, model_id, dimension)
            return found
        values = {"name": session, "created_at": now, "model_id": model_id, "dimension": dimension}
        added = await connection.execute(sa.insert(sessions), values)
        begun = SessionRow(_new_id(added), session, model_id, dimension)
        await self._database.began(connection, begun.id)
        return begun

    async def _page(self, query: sa.Select, limit: int) -> tuple[Sequence[sa.Row], int | None]:
        async with self._database.read() as connection:
            rows = (await connection.execute(query.limit(limit + 1))).all()
        following = rows[limit - 1].id if len(rows) > limit else None
        return rows[:limit], following


async def session_info(connection: AsyncConnection, session: int) -> records.SessionInfo:
    """A session by row id, as a transaction sees it."""
    query = _session_infos().where(sessions.c.id == session)
    return _session_info((await connection.execute(query)).one())


def require_model(session: SessionRow, model_id: str, dimension: int) -> None:
    """Raise DescriptorModelMismatch, naming both, unless the session has this encoder."""
    if (session.model_id, session.dimension) != (model_id, dimension):
        raise DescriptorModelMismatch(
            f"{names.session_name(session.name)} is pinned to descriptors of {session.model_id!r} "
            f"({session.dimension} numbers), the agent's are of {model_id!r} ({dimension} "
            "numbers); start the agent with the session's model or begin another session"
        )


async def _find_session(connection: AsyncConnection, session: str) -> SessionRow | None:
    row = (
        await connection.execute(sa.select(sessions).where(sessions.c.name == session))
    ).one_or_none()
    return None if row is None else SessionRow(row.id, row.name, row.model_id, row.dimension)


async def _find_agent(
    connection: AsyncConnection, session: SessionRow, agent: str
) -> AgentRow | None:
    query = sa.select(agents).where(agents.c.session_id == session.id, agents.c.name == agent)
    row = (await connection.execute(query)).one_or_none()
    return None if row is None else AgentRow(row.id, session, row.name, row.finished)


async def _next_submap_index(connection: AsyncConnection, agent_id: int) -> int:
    """One more than the agent's last sub-map, deleted ones included."""
    return (await connection.execute(sa.select(_last_number(agent_id)))).scalar_one() + 1


async def _touch(connection: AsyncConnection, agent_id: int, now: float) -> None:
    change = sa.update(agents).where(agents.c.id == agent_id)
    await connection.execute(change.values(last_seen_at=now))


def _last_number(agent: int | sa.Column) -> sa.ColumnElement[int]:
    """The highest number an agent has used, deleted sub-maps included; -1 before the first."""
    highest = [
        sa.func.coalesce(
            sa.select(sa.func.max(table.c.number))
            .where(table.c.agent_id == agent)
            .scalar_subquery(),
            -1,
        )
        for table in (submaps, removed_submaps)
    ]
    return greatest(*highest)


def _count(column: sa.Column) -> sa.ScalarSelect:
    return sa.select(sa.func.count()).where(column == sessions.c.id).scalar_subquery()


def _sum_of_bytes(condition: sa.ColumnElement[bool]) -> sa.ScalarSelect:
    return sa.select(total(submaps.c.stored_bytes)).where(condition).scalar_subquery()


def _new_id(result: sa.CursorResult) -> int:
    key = result.inserted_primary_key
    assert key is not None  # every table here has an integer primary key
    return int(key[0])


def _session_infos() -> sa.Select:
    return sa.select(
        sessions,
        _count(agents.c.session_id).label("agent_count"),
        _count(submaps.c.session_id).label("submap_count"),
        _sum_of_bytes(submaps.c.session_id == sessions.c.id).label("stored_bytes"),
        sa.select(snapshots.c.revision)
        .where(snapshots.c.session_id == sessions.c.id)
        .scalar_subquery()
        .label("revision"),
        sa.select(sa.func.count())
        .where(loops.c.session_id == sessions.c.id, loops.c.verdict == "PENDING")
        .scalar_subquery()
        .label("pending_loops"),
    )


def _session_info(row: sa.Row) -> records.SessionInfo:
    return records.SessionInfo(
        name=names.session_name(row.name),
        created_at=moment(row.created_at),
        descriptor_model_id=row.model_id,
        descriptor_dimension=row.dimension,
        agent_count=row.agent_count,
        submap_count=row.submap_count,
        stored_bytes=row.stored_bytes,
        revision=row.revision or 0,
        pending_loops=row.pending_loops,
    )


def _agent_info(session: str, row: sa.Row) -> records.AgentInfo:
    return records.AgentInfo(
        name=names.agent_name(session, row.name),
        state="FINISHED" if row.finished else "ACTIVE",
        registered_at=moment(row.registered_at),
        last_seen_at=moment(row.last_seen_at),
        submap_count=row.submap_count,
        next_submap_index=row.last + 1,
    )
