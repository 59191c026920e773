"""A session's rows as one message, and back in one transaction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sqlalchemy as sa
from magicslam.v1 import archive_pb2
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import AlreadyExists, NotFound
from magic_core.submap import OdometryEdge
from magic_core.wire import convert, geometry, names, records
from magic_server.snapshot_changes import merged_bytes
from magic_server.store import imports
from magic_server.store.agents import session_info
from magic_server.store.database import Database
from magic_server.store.imports import Imported, ImportRequest
from magic_server.store.loops import loop_columns, loop_record
from magic_server.store.rows import NewSubmap, SessionRow, pack, unpack
from magic_server.store.schema import (
    agents,
    loops,
    map_files,
    maps,
    removed_submaps,
    sessions,
    snapshot_changes,
    snapshots,
    submap_blobs,
    submaps,
)
from magic_server.store.submaps import submap_columns


@dataclass(frozen=True, slots=True)
class SessionRows:
    """Everything the database knows of a session."""

    session: sa.Row
    agents: Sequence[sa.Row]
    submaps: Sequence[sa.Row]
    removed: Sequence[sa.Row]
    loops: Sequence[sa.Row]
    snapshot: bytes | None
    settled: bool
    maps: Sequence[sa.Row]
    map_files: Sequence[sa.Row]


@dataclass(frozen=True, slots=True)
class ImportedSubmap:
    """A checked sub-map of an archive."""

    agent: str
    submap: NewSubmap
    received_at: float
    searched: bool


class ArchiveTable:
    """Reads and writes whole sessions."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def rows(self, session: str) -> SessionRows:
        """All of a session at one instant; NotFound without it."""
        # As a writer, so that nothing changes between the queries.
        async with self._database.write() as connection:
            await self._database.freeze(connection)
            query = sa.select(sessions).where(sessions.c.name == session)
            row = (await connection.execute(query)).one_or_none()
            if row is None:
                raise NotFound(f"{names.session_name(session)} does not exist")
            mine = {"session_id": row.id}
            name = agents.c.name.label("agent")
            files = sa.select(map_files).join(maps).where(maps.c.session_id == row.id)
            return SessionRows(
                session=row,
                agents=await _all(connection, sa.select(agents).filter_by(**mine), agents.c.id),
                submaps=await _all(
                    connection,
                    sa.select(submaps, name).join(agents).where(submaps.c.session_id == row.id),
                    submaps.c.id,
                ),
                removed=await _all(
                    connection,
                    sa.select(removed_submaps, name)
                    .join(agents)
                    .where(removed_submaps.c.session_id == row.id),
                    removed_submaps.c.agent_id,
                ),
                loops=await _all(connection, sa.select(loops).filter_by(**mine), loops.c.id),
                snapshot=await _solution(connection, row.id),
                settled=bool(
                    await connection.scalar(
                        sa.select(snapshots.c.settled).where(snapshots.c.session_id == row.id)
                    )
                ),
                maps=await _all(connection, sa.select(maps).filter_by(**mine), maps.c.id),
                map_files=await _all(connection, files, map_files.c.map_id),
            )

    async def first_answer(self, asked: ImportRequest) -> Imported | None:
        """What this import was answered before; AlreadyExists for another archive's id."""
        async with self._database.read() as connection:
            return await imports.first_answer(connection, asked)

    async def insert(
        self,
        archive: archive_pb2.SessionArchive,
        imported: Sequence[ImportedSubmap],
        asked: ImportRequest,
    ) -> Imported:
        """Store a checked archive, unless the same request did so meanwhile.

        Raises AlreadyExists when there is a session of its name.
        """
        info = convert.session_from_proto(archive.session)
        name = names.parse_session(info.name)
        async with self._database.write() as connection:
            await self._database.lock_name(connection, name)
            if (first := await imports.first_answer(connection, asked)) is not None:
                return first
            taken = sa.select(sessions.c.id).where(sessions.c.name == name)
            if await connection.scalar(taken) is not None:
                raise AlreadyExists(f"{info.name} exists already; delete it before importing it")
            values = {"name": name, "created_at": info.created_at.timestamp()}
            values |= {"model_id": info.descriptor_model_id, "dimension": info.descriptor_dimension}
            session_id = await _insert(connection, sessions, values)
            await self._database.began(connection, session_id)
            row = SessionRow(session_id, name, info.descriptor_model_id, info.descriptor_dimension)
            owners = await _insert_agents(connection, archive, session_id)
            for one in imported:
                await _insert_submap(connection, one, row, owners[one.agent])
            await _insert_rest(connection, archive, session_id, owners)
            answer = await session_info(connection, session_id)
            await imports.remember(connection, asked, answer)
            return Imported(answer, repeated=False)


def archive_of(rows: SessionRows) -> tuple[archive_pb2.SessionArchive, dict[str, int]]:
    """A session's message, and the length of each of its blobs by digest, in order of first use."""
    name = rows.session.name
    lengths: dict[str, int] = {}
    archive = archive_pb2.SessionArchive()
    for row in rows.submaps:
        entry = archive.submaps.add(searched=row.searched)
        entry.header.ParseFromString(row.header)
        entry.received_at.CopyFrom(_moment(row.received_at))
        lengths.update((blob.sha256.hex(), blob.length) for blob in entry.header.blobs)
    files: dict[int, list[sa.Row]] = {}
    for row in rows.map_files:
        files.setdefault(row.map_id, []).append(row)
        lengths[row.sha256] = row.length
    for row in rows.maps:
        _add_map(archive, name, row, files.get(row.id, []))
    for row in rows.removed:
        _add_removed(archive, name, row)
    archive.loops.extend(convert.loop_to_proto(loop_record(row)) for row in rows.loops)
    archive.agents.extend(_agents(rows))
    if rows.snapshot is not None:
        archive.snapshot.ParseFromString(rows.snapshot)
        archive.settled = rows.settled
    session = archive.session
    session.name = names.session_name(name)
    session.created_at.CopyFrom(_moment(rows.session.created_at))
    session.descriptor_model_id = rows.session.model_id
    session.descriptor_dimension = rows.session.dimension
    session.agent_count, session.submap_count = len(rows.agents), len(rows.submaps)
    session.stored_bytes = sum(row.stored_bytes for row in rows.submaps)
    session.revision = archive.snapshot.revision
    session.pending_loops = sum(row.verdict == "PENDING" for row in rows.loops)
    return archive, lengths


def _agents(rows: SessionRows):
    counts: dict[str, list[int]] = {}
    for row in (*rows.submaps, *rows.removed):
        counts.setdefault(row.agent, []).append(row.number)
    for row in rows.agents:
        numbers = counts.get(row.name, [])
        yield convert.agent_to_proto(
            records.AgentInfo(
                name=names.agent_name(rows.session.name, row.name),
                state="FINISHED" if row.finished else "ACTIVE",
                registered_at=convert.moment(row.registered_at),
                last_seen_at=convert.moment(row.last_seen_at),
                submap_count=sum(one.agent == row.name for one in rows.submaps),
                next_submap_index=max(numbers, default=-1) + 1,
            )
        )


def _add_map(
    archive: archive_pb2.SessionArchive, session: str, row: sa.Row, files: list[sa.Row]
) -> None:
    info = records.GlobalMapInfo(
        name=names.map_name(session, str(row.id)),
        component=row.component,
        revision=row.revision,
        submaps=tuple(row.submaps),
        gaussian_count=row.gaussian_count,
        created_at=convert.moment(row.created_at),
    )
    entry = archive.maps.add(map=convert.map_to_proto(info))
    for file in files:
        entry.files.add(
            format=convert.map_format_to_proto(file.format),
            length=file.length,
            sha256=bytes.fromhex(file.sha256),
        )


def _add_removed(archive: archive_pb2.SessionArchive, session: str, row: sa.Row) -> None:
    entry = archive.removed.add(
        name=names.submap_name(session, row.agent, row.number),
        request_id=row.request_id,
        header_sha256=row.header_sha256,
        received_at=_moment(row.received_at),
        stored_bytes=row.stored_bytes,
    )
    motion, information = unpack(row.previous_from_anchor, 4), unpack(row.information, 6)
    if motion is not None and information is not None:
        edge = OdometryEdge(row.previous_number, motion, information)
        entry.odometry.previous_index = edge.previous_index
        entry.odometry.previous_from_anchor.CopyFrom(geometry.pose_to_proto(motion))
        entry.odometry.information.extend(geometry.information_to_list(information))
    if (prior := unpack(row.prior, 4)) is not None:
        entry.world_from_anchor_prior.CopyFrom(geometry.pose_to_proto(prior))


def _moment(seconds: float):
    return convert.timestamp_to_proto(convert.moment(seconds))


async def _all(connection: AsyncConnection, query: sa.Select, order: sa.Column) -> Sequence[sa.Row]:
    return (await connection.execute(query.order_by(order))).all()


async def _insert(
    connection: AsyncConnection, table: sa.Table, values: Mapping[str, object]
) -> int:
    key = (await connection.execute(sa.insert(table), values)).inserted_primary_key
    assert key is not None  # the table has an integer primary key
    return int(key[0])


async def _insert_agents(
    connection: AsyncConnection, archive: archive_pb2.SessionArchive, session_id: int
) -> dict[str, int]:
    """The row ids of the agents, by their ids."""
    owners = {}
    for message in archive.agents:
        agent = convert.agent_from_proto(message)
        _, name = names.parse_agent(agent.name)
        values = {"session_id": session_id, "name": name, "finished": agent.state == "FINISHED"}
        values |= {"registered_at": agent.registered_at.timestamp()}
        values |= {"last_seen_at": agent.last_seen_at.timestamp()}
        owners[name] = await _insert(connection, agents, values)
    return owners


async def _insert_submap(
    connection: AsyncConnection, one: ImportedSubmap, session: SessionRow, agent_id: int
) -> None:
    values = submap_columns(session.id, agent_id, one.submap)
    values |= {"received_at": one.received_at, "searched": one.searched}
    key = await _insert(connection, submaps, values)
    rows = [
        {"submap_id": key, "position": position, "sha256": digest}
        for position, digest in enumerate(one.submap.digests)
    ]
    await connection.execute(sa.insert(submap_blobs), rows)


async def _solution(connection: AsyncConnection, session_id: int) -> bytes | None:
    """The newest solution, None before the first."""
    whole = await connection.scalar(
        sa.select(snapshots.c.snapshot).where(snapshots.c.session_id == session_id)
    )
    since = sa.select(snapshot_changes.c.change)
    since = since.where(snapshot_changes.c.session_id == session_id)
    changes = await connection.scalars(since.order_by(snapshot_changes.c.revision))
    return None if whole is None else merged_bytes(whole, changes)


async def _insert_rest(
    connection: AsyncConnection,
    archive: archive_pb2.SessionArchive,
    session_id: int,
    owners: dict[str, int],
) -> None:
    """Deleted sub-maps, loops, solution and maps."""
    mine = {"session_id": session_id}
    removed = [mine | _removed_columns(entry, owners) for entry in archive.removed]
    found = [mine | loop_columns(convert.loop_from_proto(loop)) for loop in archive.loops]
    for table, rows in ((removed_submaps, removed), (loops, found)):
        if rows:
            await connection.execute(sa.insert(table), rows)
    if archive.HasField("snapshot"):
        snapshot = archive.snapshot
        values = {"revision": snapshot.revision, "snapshot": snapshot.SerializeToString()}
        values |= {"settled": archive.settled}
        await connection.execute(sa.insert(snapshots), mine | values)
    for entry in archive.maps:
        info = convert.map_from_proto(entry.map)
        values = {"component": info.component, "revision": info.revision}
        values |= {"submaps": list(info.submaps), "gaussian_count": info.gaussian_count}
        values |= {"created_at": info.created_at.timestamp()}
        key = await _insert(connection, maps, mine | values)
        files = [
            {
                "map_id": key,
                "format": convert.map_format_from_proto(file.format),
                "sha256": file.sha256.hex(),
                "length": file.length,
            }
            for file in entry.files
        ]
        await connection.execute(sa.insert(map_files), files)


def _removed_columns(
    entry: archive_pb2.ArchivedRemoval, owners: dict[str, int]
) -> dict[str, object]:
    _, agent, number = names.parse_submap(entry.name)
    values: dict[str, object] = {
        "agent_id": owners[agent],
        "number": number,
        "request_id": entry.request_id,
        "header_sha256": entry.header_sha256,
        "received_at": convert.timestamp_from_proto(entry.received_at).timestamp(),
        "stored_bytes": entry.stored_bytes,
        "previous_number": None,
        "previous_from_anchor": None,
        "information": None,
        "prior": None,
    }
    if entry.HasField("odometry"):
        edge = entry.odometry
        values["previous_number"] = edge.previous_index
        motion = geometry.pose_from_proto(edge.previous_from_anchor)
        values["previous_from_anchor"] = pack(motion)
        values["information"] = pack(geometry.information_from_list(edge.information))
    if entry.HasField("world_from_anchor_prior"):
        values["prior"] = pack(geometry.pose_from_proto(entry.world_from_anchor_prior))
    return values
