"""First answers of requests that change an agent, so that a repeat gets the same.

Sub-maps and operations carry the id of their request themselves; deletions have a table of their
own, because what they name is gone.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from google.protobuf.message import Message
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import AlreadyExists
from magic_server.store.schema import answers

REMEMBERED_S = 30 * 86400.0
"""First answers are kept this long."""
MOST_PER_AGENT = 1000
"""The oldest of an agent's answers go when there are more."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A request: its id, what it asks, and when it came."""

    request_id: str
    digest: bytes
    now: float

    @classmethod
    def of(cls, request: Message, *, request_id: str, now: float) -> Asked:
        """A request message under its id."""
        content = request.SerializeToString(deterministic=True)
        kind = request.DESCRIPTOR.full_name.encode()
        return cls(request_id, hashlib.sha256(kind + b"\n" + content).digest(), now)


async def first_answer(
    connection: AsyncConnection, agent_id: int, asked: Asked
) -> dict[str, Any] | None:
    """What this request was answered before, or None.

    Raises AlreadyExists when the id belongs to a request that asked something else.
    """
    mine = sa.and_(answers.c.agent_id == agent_id, answers.c.request_id == asked.request_id)
    query = sa.select(answers.c.request_sha256, answers.c.answer).where(mine)
    row = (await connection.execute(query)).one_or_none()
    if row is None:
        return None
    if row.request_sha256 != asked.digest:
        raise AlreadyExists(
            f"request_id {asked.request_id!r} was used for another request of this agent; "
            "give each request an id of its own"
        )
    return json.loads(row.answer)


async def remember(
    connection: AsyncConnection, agent_id: int, asked: Asked, answer: dict[str, Any]
) -> None:
    """Keep an answer, within the transaction that it speaks of."""
    mine = answers.c.agent_id == agent_id
    newest = sa.select(answers.c.id).where(mine).order_by(answers.c.id.desc())
    beyond = sa.and_(mine, answers.c.id.not_in(newest.limit(MOST_PER_AGENT - 1)))
    old = answers.c.answered_at < asked.now - REMEMBERED_S
    await connection.execute(sa.delete(answers).where(sa.or_(old, beyond)))
    row = {
        "agent_id": agent_id,
        "request_id": asked.request_id,
        "request_sha256": asked.digest,
        "answer": json.dumps(answer),
        "answered_at": asked.now,
    }
    await connection.execute(sa.insert(answers), row)
