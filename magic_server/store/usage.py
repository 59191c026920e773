"""How much is stored, as quotas ask: answered from an index, without touching a sub-map's row."""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa

from magic_server.store.database import Database
from magic_server.store.engines import total
from magic_server.store.rows import AgentRow
from magic_server.store.schema import agents, sessions, submaps

# The rows hold large headers: without this index a sum would read them all.
sa.Index("submaps_usage", submaps.c.session_id, submaps.c.agent_id, submaps.c.stored_bytes)


@dataclass(frozen=True, slots=True)
class Usage:
    """What is stored for an agent or a session."""

    submaps: int
    bytes: int


@dataclass(frozen=True, slots=True)
class Population:
    """How many there are, and who would be new."""

    sessions: int
    agents: int
    """In the session asked for."""
    session_is_new: bool
    agent_is_new: bool


class UsageTable:
    """Counts and sums."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def of_agent(self, agent: AgentRow) -> Usage:
        """What is stored for an agent."""
        mine = sa.and_(submaps.c.session_id == agent.session.id, submaps.c.agent_id == agent.id)
        return await self._usage(mine)

    async def of_session(self, agent: AgentRow) -> Usage:
        """What is stored in the session of an agent."""
        return await self._usage(submaps.c.session_id == agent.session.id)

    async def population(self, session: str, agent: str) -> Population:
        """Sessions and agents, seen from an agent that wants to enter a session."""
        here = sa.and_(agents.c.session_id == sessions.c.id, sessions.c.name == session)
        count = sa.func.count()
        queries = (
            sa.select(count).select_from(sessions),
            sa.select(count).select_from(agents).where(here),
            sa.select(count).select_from(sessions).where(sessions.c.name == session),
            sa.select(count).select_from(agents).where(here, agents.c.name == agent),
        )
        async with self._database.read() as connection:
            found = [await connection.scalar(query) or 0 for query in queries]
        return Population(found[0], found[1], found[2] == 0, found[3] == 0)

    async def _usage(self, condition: sa.ColumnElement[bool]) -> Usage:
        query = sa.select(sa.func.count(), total(submaps.c.stored_bytes)).where(condition)
        async with self._database.read() as connection:
            row = (await connection.execute(query)).one()
        return Usage(*row)
