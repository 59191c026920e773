"""Sub-maps in the store."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import sqlalchemy as sa
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import NotFound
from magic_core.submap import Descriptor, OdometryEdge
from magic_core.wire import names, records
from magic_core.wire.convert import moment
from magic_server.store.blob_store import BlobStore
from magic_server.store.database import Database
from magic_server.store.rows import (
    AgentRow,
    NewSubmap,
    RemovedSubmap,
    SessionRow,
    StoredSubmap,
    Vertex,
    pack,
    pack_keyframes,
    unpack,
    unpack_keyframes,
)
from magic_server.store.schema import agents, removed_submaps, submap_blobs, submaps

_SUMMARY = (
    submaps.c.id,
    submaps.c.number,
    submaps.c.received_at,
    submaps.c.first_timestamp_s,
    submaps.c.last_timestamp_s,
    submaps.c.frame_count,
    submaps.c.keyframe_count,
    submaps.c.gaussian_count,
    submaps.c.stored_bytes,
    agents.c.name.label("agent"),
)
READ_AT_ONCE = 500
"""Sub-maps in memory at a time while a session is gone through."""
_VERTICES = sa.select(
    *(column for column in submaps.c if column.name != "header"), agents.c.name.label("agent")
).join(agents)


@dataclass(frozen=True, slots=True)
class FirstAnswer:
    """What was answered to a sub-map that is stored already."""

    request_id: str
    header_sha256: bytes
    received_at: float
    stored_bytes: int


@dataclass(frozen=True, slots=True)
class Arrival:
    """A sub-map that has come as a whole."""

    agent: AgentRow
    submap: NewSubmap
    at: float
    """When, seconds since the epoch."""

    @property
    def place(self) -> tuple[int, int]:
        """What no two sub-maps share: row id of the agent, and number."""
        return self.agent.id, self.submap.vertex.index


class SubmapTable:
    """Sub-maps, their headers and which blobs they hold."""

    def __init__(self, database: Database, blobs: BlobStore) -> None:
        self._database = database
        self._blobs = blobs

    async def insert(self, arrivals: Sequence[Arrival]) -> None:
        """The one transaction that makes sub-maps part of their sessions: all of them, or none.

        NotFound when the agent of one was deleted meanwhile.
        """
        sessions = {arrival.agent.session.id for arrival in arrivals}
        async with self._database.write(*sessions) as connection:
            for arrival in arrivals:
                await _insert(connection, arrival)

    async def first_answers(
        self, places: Sequence[tuple[int, int]]
    ) -> dict[tuple[int, int], FirstAnswer]:
        """The first answers of those that are stored already, deleted or not, by their places."""
        found: dict[tuple[int, int], FirstAnswer] = {}
        async with self._database.read() as connection:
            for table in (submaps, removed_submaps):
                agent, number = table.c.agent_id, table.c.number
                columns = (table.c[field.name] for field in fields(FirstAnswer))
                mine = sa.tuple_(agent, number).in_(places)
                query = sa.select(agent, number, *columns).where(mine)
                for row in await connection.execute(query):
                    found.setdefault((row.agent_id, row.number), FirstAnswer(*tuple(row)[2:]))
        return found

    async def first_answer(self, agent: AgentRow, index: int) -> FirstAnswer | None:
        """The answer that a sub-map got when it was stored, deleted or not, or None."""
        place = (agent.id, index)
        return (await self.first_answers([place])).get(place)

    async def number_of_request(self, agent: AgentRow, request_id: str) -> int | None:
        """The index of the sub-map, deleted or not, that an agent's request stored, or None."""
        async with self._database.read() as connection:
            for table in (submaps, removed_submaps):
                mine = sa.and_(table.c.agent_id == agent.id, table.c.request_id == request_id)
                found = await connection.scalar(sa.select(table.c.number).where(mine))
                if found is not None:
                    return found
        return None

    async def stored(self, session: SessionRow, agent: str, index: int) -> StoredSubmap:
        """A sub-map's header and blobs; NotFound when it is not stored."""
        name = names.submap_name(session.name, agent, index)
        query = sa.select(submaps.c.id, submaps.c.header).join(agents)
        query = query.where(_is(session, agent, index))
        async with self._database.read() as connection:
            row = (await connection.execute(query)).one_or_none()
            if row is None:
                raise NotFound(f"{name} is not stored")
            digests = sa.select(submap_blobs.c.sha256).where(submap_blobs.c.submap_id == row.id)
            found = await connection.scalars(digests.order_by(submap_blobs.c.position))
            blobs = tuple(self._blobs.blob(sha256) for sha256 in found)
        return StoredSubmap(row.header, blobs)

    async def pages(self, session: SessionRow) -> AsyncIterator[list[Vertex]]:
        """Every sub-map of a session as index and pose graph need it, in order of arrival.

        Some at a time: with their descriptors, all of them may be more than there is memory.
        """
        query = _VERTICES.where(submaps.c.session_id == session.id)
        query = query.order_by(submaps.c.id).limit(READ_AT_ONCE)
        after = 0
        while True:
            async with self._database.read() as connection:
                rows = (await connection.execute(query.where(submaps.c.id > after))).all()
            if not rows:
                return
            after = rows[-1].id
            yield [_vertex(session, row) for row in rows]

    async def vertex(self, session: SessionRow, agent: str, index: int) -> Vertex:
        """One of them; NotFound when it is not stored."""
        async with self._database.read() as connection:
            found = await connection.execute(_VERTICES.where(_is(session, agent, index)))
            row = found.one_or_none()
        if row is None:
            raise NotFound(f"{names.submap_name(session.name, agent, index)} is not stored")
        return _vertex(session, row)

    async def removed(self, session: SessionRow) -> list[RemovedSubmap]:
        """The deleted sub-maps of agents that are still there."""
        query = sa.select(removed_submaps, agents.c.name.label("agent")).join(agents)
        query = query.where(removed_submaps.c.session_id == session.id)
        async with self._database.read() as connection:
            rows = (await connection.execute(query)).all()
        return [
            RemovedSubmap(
                names.submap_name(session.name, row.agent, row.number),
                _odometry(row),
                unpack(row.prior, 4),
            )
            for row in rows
        ]

    async def page(
        self, session: SessionRow, *, agent: str | None = None, after: int = 0, limit: int = 100
    ) -> tuple[list[records.SubmapInfo], int | None]:
        """Sub-maps behind row id `after` in order of arrival, and where the next page begins."""
        query = sa.select(*_SUMMARY).join(agents)
        query = query.where(submaps.c.session_id == session.id, submaps.c.id > after)
        if agent is not None:
            query = query.where(agents.c.name == agent)
        async with self._database.read() as connection:
            rows = (await connection.execute(query.order_by(submaps.c.id).limit(limit + 1))).all()
        following = rows[limit - 1].id if len(rows) > limit else None
        return [_info(session, row) for row in rows[:limit]], following

    async def info(self, session: SessionRow, agent: str, index: int) -> records.SubmapInfo:
        """Summary of one sub-map; NotFound when it is not stored."""
        query = sa.select(*_SUMMARY).join(agents).where(_is(session, agent, index))
        async with self._database.read() as connection:
            row = (await connection.execute(query)).one_or_none()
        if row is None:
            raise NotFound(f"{names.submap_name(session.name, agent, index)} is not stored")
        return _info(session, row)


async def _insert(connection: AsyncConnection, arrival: Arrival) -> None:
    """The rows of one sub-map; NotFound without its agent."""
    agent, submap = arrival.agent, arrival.submap
    seen = sa.update(agents).where(agents.c.id == agent.id).values(last_seen_at=arrival.at)
    if not (await connection.execute(seen)).rowcount:
        name = names.agent_name(agent.session.name, agent.name)
        raise NotFound(f"{name} was deleted while it submitted a sub-map")
    values = submap_columns(agent.session.id, agent.id, submap)
    values |= {"received_at": arrival.at, "searched": False}
    added = await connection.execute(sa.insert(submaps), values)
    key = added.inserted_primary_key
    assert key is not None  # the table has an integer primary key
    rows = [
        {"submap_id": key[0], "position": position, "sha256": digest}
        for position, digest in enumerate(submap.digests)
    ]
    await connection.execute(sa.insert(submap_blobs), rows)


def _is(session: SessionRow, agent: str, index: int) -> sa.ColumnElement[bool]:
    # The agent's row first: through the session every sub-map of it would be looked at.
    mine = sa.and_(agents.c.session_id == session.id, agents.c.name == agent)
    row = sa.select(agents.c.id).where(mine).correlate(None).scalar_subquery()
    return sa.and_(submaps.c.agent_id == row, submaps.c.number == index)


def submap_columns(session_id: int, agent_id: int, submap: NewSubmap) -> dict[str, object]:
    """A sub-map as the values of its row; when it came and whether it was searched left out."""
    header, vertex = submap.header, submap.vertex
    edge = vertex.odometry
    return {
        "session_id": session_id,
        "agent_id": agent_id,
        "number": vertex.index,
        "request_id": header.request_id,
        "header_sha256": submap.header_sha256,
        "header": header.SerializeToString(),
        "first_timestamp_s": header.trajectory[0].timestamp_s,
        "last_timestamp_s": header.trajectory[-1].timestamp_s,
        "frame_count": len(header.trajectory),
        "keyframe_count": len(header.keyframes),
        "gaussian_count": submap.gaussian_count,
        "stored_bytes": sum(blob.length for blob in header.blobs),
        "descriptor": vertex.descriptor.vector.astype("<f4").tobytes(),
        "keyframe_descriptors": pack_keyframes(vertex.keyframes),
        "previous_number": None if edge is None else edge.previous_index,
        "previous_from_anchor": None if edge is None else pack(edge.previous_from_anchor),
        "information": None if edge is None else pack(edge.information),
        "prior": pack(vertex.prior),
    }


def _odometry(row: sa.Row) -> OdometryEdge | None:
    motion, information = unpack(row.previous_from_anchor, 4), unpack(row.information, 6)
    if motion is None or information is None:
        return None
    return OdometryEdge(row.previous_number, motion, information)


def _vertex(session: SessionRow, row: sa.Row) -> Vertex:
    vector = np.frombuffer(row.descriptor, "<f4").astype(np.float32)
    return Vertex(
        name=names.submap_name(session.name, row.agent, row.number),
        agent=sys.intern(names.agent_name(session.name, row.agent)),
        index=row.number,
        descriptor=Descriptor(session.model_id, vector),
        odometry=_odometry(row),
        prior=unpack(row.prior, 4),
        searched=row.searched,
        span_s=(row.first_timestamp_s, row.last_timestamp_s),
        keyframes=unpack_keyframes(row.keyframe_descriptors, len(vector)),
    )


def _info(session: SessionRow, row: sa.Row) -> records.SubmapInfo:
    return records.SubmapInfo(
        name=names.submap_name(session.name, row.agent, row.number),
        received_at=moment(row.received_at),
        first_timestamp_s=row.first_timestamp_s,
        last_timestamp_s=row.last_timestamp_s,
        frame_count=row.frame_count,
        keyframe_count=row.keyframe_count,
        gaussian_count=row.gaussian_count,
        stored_bytes=row.stored_bytes,
    )
