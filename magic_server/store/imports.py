"""First answers of imports, so that a repeat gets the same and stores nothing."""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa
from magicslam.v1 import session_service_pb2 as session_pb
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import AlreadyExists
from magic_core.wire import convert, records
from magic_server.store.schema import imports

REMEMBERED_S = 30 * 86400.0
"""First answers are kept this long."""


@dataclass(frozen=True, slots=True)
class ImportRequest:
    """Who asked to import what, and when."""

    name: str
    """Resource name of the session."""
    request_id: str
    archive_sha256: bytes
    """Digest of the archive's manifest, which holds those of all its files."""
    now: float


@dataclass(frozen=True, slots=True)
class Imported:
    """What an import is answered."""

    session: records.SessionInfo
    repeated: bool
    """It was stored by an earlier request with this id."""


async def first_answer(connection: AsyncConnection, asked: ImportRequest) -> Imported | None:
    """What this request was answered before, or None.

    Raises AlreadyExists when the id belongs to the import of another archive.
    """
    mine = sa.and_(imports.c.name == asked.name, imports.c.request_id == asked.request_id)
    query = sa.select(imports.c.archive_sha256, imports.c.answer).where(mine)
    row = (await connection.execute(query)).one_or_none()
    if row is None:
        return None
    if row.archive_sha256 != asked.archive_sha256:
        raise AlreadyExists(
            f"request_id {asked.request_id!r} was used for another archive of {asked.name}; "
            "give each request an id of its own"
        )
    session = convert.session_from_proto(session_pb.Session.FromString(row.answer))
    return Imported(session, repeated=True)


async def remember(
    connection: AsyncConnection, asked: ImportRequest, answer: records.SessionInfo
) -> None:
    """Keep an answer, within the transaction that it speaks of."""
    old = imports.c.imported_at < asked.now - REMEMBERED_S
    await connection.execute(sa.delete(imports).where(old))
    row = {
        "name": asked.name,
        "request_id": asked.request_id,
        "archive_sha256": asked.archive_sha256,
        "answer": convert.session_to_proto(answer).SerializeToString(),
        "imported_at": asked.now,
    }
    await connection.execute(sa.insert(imports), row)
