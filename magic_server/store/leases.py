"""Leases: which server works on a session when several share the database.

A lease has a holder and a token that counts up when the holder changes. Every transaction about a
session locks the lease's row and requires holder and token to be this server's: one that lost the
lease, and does not know it yet, cannot write. Times are the database's, never a server's.
"""

from __future__ import annotations

import uuid
from collections.abc import Collection

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.exc import IntegrityError
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import HeldElsewhere, NotFound
from magic_core.wire import names
from magic_server.store.database import Database
from magic_server.store.rows import SessionRow
from magic_server.store.schema import leases, sessions

_NOW = sa.cast(sa.func.extract("epoch", sa.func.clock_timestamp()), sa.Float)


class LeaseTable:
    """The leases of one run of one server, and the fence around its writes."""

    def __init__(self, database: Database, replica: str) -> None:
        self._database = database
        self._replica = replica
        # An earlier run of this server is dead, but has to be told apart from this one.
        self._holder = f"{replica}/{uuid.uuid4().hex}"
        self._tokens: dict[int, int] = {}
        self._address = ""
        self._lease_s = 0.0

    def begin(self, *, address: str, lease_s: float) -> None:
        """From now on leases are taken, for clients to find this server at an address."""
        self._address, self._lease_s = address, lease_s

    async def require(self, connection: AsyncConnection, session: int) -> None:
        """Raise HeldElsewhere unless this server holds a session; it does until the commit."""
        query = sa.select(leases.c.holder, leases.c.token, leases.c.address)
        query = query.where(leases.c.session_id == session).with_for_update()
        row = (await connection.execute(query)).one_or_none()
        if row is None:
            raise NotFound("the session was deleted meanwhile")
        if row.holder != self._holder or row.token != self._tokens.get(session):
            raise _elsewhere("the session", "" if row.holder == self._holder else row.address)

    async def add(self, connection: AsyncConnection, session: int) -> None:
        """Take the lease of a session that begins in this transaction."""
        row = {"session_id": session, "token": 1} | self._mine()
        await connection.execute(insert(leases).values(row))
        self._tokens[session] = 1

    async def take(self, session: SessionRow) -> None:
        """Take a session's lease, or keep it. HeldElsewhere while another server has it."""
        same = leases.c.holder == self._holder
        free = sa.or_(same, leases.c.expires_at < _NOW, self._of_earlier_run())
        token = sa.case((same, leases.c.token), else_=leases.c.token + 1)
        taken = insert(leases).values({"session_id": session.id, "token": 1} | self._mine())
        taken = taken.on_conflict_do_update(
            index_elements=[leases.c.session_id],
            set_=self._mine() | {"token": token},
            where=free,
        ).returning(leases.c.token)
        other = sa.select(leases.c.address).where(leases.c.session_id == session.id)
        async with self._database.write() as connection:
            try:
                found = await connection.scalar(taken)
            except IntegrityError as error:
                raise NotFound(f"{names.session_name(session.name)} was deleted") from error
            if found is None:
                address = await connection.scalar(other)
                raise _elsewhere(names.session_name(session.name), address or "")
        self._tokens[session.id] = found

    async def renew(self) -> tuple[set[int], set[int]]:
        """Keep every lease for another while; returns the sessions that are held, and were."""
        before = dict(self._tokens)
        change = sa.update(leases).where(leases.c.holder == self._holder)
        change = change.values(expires_at=_NOW + self._lease_s)
        async with self._database.write() as connection:
            rows = await connection.execute(change.returning(leases.c.session_id, leases.c.token))
            found = {row.session_id: row.token for row in rows}
        kept = {session for session, token in before.items() if found.get(session) == token}
        return kept, {one for one in before.keys() - kept if self._tokens.get(one) == before[one]}

    def forget(self, session: int) -> None:
        """Write no more about a session."""
        self._tokens.pop(session, None)

    async def free(self, limit: int) -> list[SessionRow]:
        """Some of the sessions that no server holds, any of them first."""
        query = sa.select(sessions).outerjoin(leases)
        vacant = sa.or_(
            leases.c.session_id.is_(None), leases.c.expires_at < _NOW, self._of_earlier_run()
        )
        query = query.where(vacant).order_by(sa.func.random()).limit(limit)
        async with self._database.read() as connection:
            rows = await connection.execute(query)
            return [SessionRow(r.id, r.name, r.model_id, r.dimension) for r in rows]

    async def release(self, held: Collection[int] | None = None) -> None:
        """Let other servers have these sessions at once; all by default."""
        change = sa.update(leases).where(leases.c.holder == self._holder)
        if held is not None:
            change = change.where(leases.c.session_id.in_(held))
        for session in list(self._tokens) if held is None else held:
            self.forget(session)
        async with self._database.write() as connection:
            await connection.execute(change.values(expires_at=0.0))

    def _of_earlier_run(self) -> sa.ColumnElement[bool]:
        # This server's name is locked, see ownership: the run that wrote this is dead.
        earlier = leases.c.holder.startswith(f"{self._replica}/", autoescape=True)
        return sa.and_(earlier, leases.c.holder != self._holder)

    def _mine(self) -> dict[str, object]:
        return {
            "holder": self._holder,
            "address": self._address,
            "expires_at": _NOW + self._lease_s,
        }


def _elsewhere(what: str, address: str) -> HeldElsewhere:
    if not address:
        return HeldElsewhere(f"{what} is changing servers; try again")
    return HeldElsewhere(f"{what} is worked on by the server at {address}", holder=address)
