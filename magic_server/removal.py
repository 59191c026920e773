"""Deleting: what is asked, whether it may be done now, and everything that must forget it."""

from __future__ import annotations

import asyncio
import time

from magic_core.errors import NotFound, WrongState
from magic_core.wire import names
from magic_server.excerpts import Excerpts
from magic_server.globalmaps import GlobalMaps
from magic_server.sessions import Sessions
from magic_server.store import AgentRow, Deleted, DeletionRequest, SessionRow, Store


class Removal:
    """Deletes sub-maps, agents and sessions, each at most once for one request id."""

    def __init__(
        self, store: Store, sessions: Sessions, maps: GlobalMaps, excerpts: Excerpts
    ) -> None:
        self._store = store
        self._sessions = sessions
        self._maps = maps
        self._excerpts = excerpts

    async def submap(self, name: str, *, request_id: str, force: bool) -> Deleted:
        """Delete a sub-map by its resource name."""
        session, agent_id, index = names.parse_submap(name)
        if first := await self._store.deletions.first_answer(name, request_id):
            return first
        agent = await self._store.agents.agent(session, agent_id)
        await self._store.submaps.info(agent.session, agent_id, index)
        _require_finished(agent, name, force=force)
        coordinator = await self._sessions.coordinator(agent.session)
        request = DeletionRequest(name, request_id, time.time())
        deleted = await coordinator.remove(
            lambda: {name},
            lambda solution: self._store.deletions.submap(agent, index, request, solution),
        )
        await self._excerpts.forget(agent.session.id)
        return deleted

    async def agent(self, name: str, *, request_id: str, force: bool) -> Deleted:
        """Delete an agent and its sub-maps by its resource name."""
        session, agent_id = names.parse_agent(name)
        if first := await self._store.deletions.first_answer(name, request_id):
            return first
        agent = await self._store.agents.agent(session, agent_id)
        _require_finished(agent, name, force=force)
        coordinator = await self._sessions.coordinator(agent.session)
        request = DeletionRequest(name, request_id, time.time())
        deleted = await coordinator.remove(
            lambda: coordinator.graph.names_of(name),
            lambda solution: self._store.deletions.agent(agent, request, solution),
            agent=name,
        )
        await asyncio.to_thread(self._store.uploads.forget, f"{name}/")
        await self._excerpts.forget(agent.session.id)
        return deleted

    async def session(self, name: str, *, request_id: str, force: bool) -> Deleted:
        """Delete a session and all it holds by its resource name."""
        session_id = names.parse_session(name)
        if first := await self._store.deletions.first_answer(name, request_id):
            return first
        session = await self._store.agents.session(session_id)
        if not force:
            await require_finished_agents(self._store, session)
        request = DeletionRequest(name, request_id, time.time())
        async with self._sessions.forgotten(session, NotFound(f"{name} was deleted")):
            await self._maps.forget(session)
            deleted = await self._store.deletions.session(session, request)
        await self._excerpts.forget(session.id)
        await asyncio.to_thread(self._store.uploads.forget, f"{name}/")
        return deleted


async def require_finished_agents(store: Store, session: SessionRow) -> None:
    """Raise WrongState while an agent of a session may still submit."""
    if active := await store.agents.active(session):
        agent = names.agent_name(session.name, active[0])
        raise WrongState(
            f"{agent} has not finished and may still submit to {names.session_name(session.name)}; "
            "finish it, or set `force` to delete all the same"
        )


def _require_finished(agent: AgentRow, name: str, *, force: bool) -> None:
    if not agent.finished and not force:
        active = names.agent_name(agent.session.name, agent.name)
        raise WrongState(
            f"{active} has not finished and may still submit; finish it, or set `force` to "
            f"delete {name} all the same"
        )
