"""The coordinators of every session of a server."""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import AsyncIterator
from concurrent.futures import Executor
from contextlib import asynccontextmanager

from magic_core.errors import MagicError
from magic_server.config import ServerConfig
from magic_server.coordinator import SessionCoordinator
from magic_server.graph import SessionGraph
from magic_server.jobs import JobExecutor
from magic_server.metrics import Metrics
from magic_server.places import DescriptorIndex
from magic_server.store import AgentRow, SessionRow, Store, Vertex


class Sessions:
    """One coordinator per session, begun when the server starts or the session does."""

    def __init__(
        self,
        store: Store,
        *,
        jobs: JobExecutor,
        threads: Executor,
        config: ServerConfig,
        metrics: Metrics,
    ) -> None:
        self._store = store
        self._jobs = jobs
        self._threads = threads
        self._config = config
        self._metrics = metrics
        self._coordinators: dict[str, SessionCoordinator] = {}
        self._lock = asyncio.Lock()
        # Sub-maps that were stored while a session's coordinator was reading the store.
        self._late: dict[str, list[Vertex]] = {}

    async def start(self, *, everything: bool = True) -> None:
        """Take up every stored session, unless they are taken one by one."""
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._threads, _load_libraries, self._config)
        if not everything:
            return
        for session in await self._store.agents.sessions():
            await self.coordinator(session)

    def backlog(self, session: str) -> int:
        """Searches and verifications that wait in a session."""
        found = self._coordinators.get(session)
        return 0 if found is None else found.waiting_searches + found.pending_loops

    def depths(self) -> dict[str, int]:
        """What waits in all sessions together, by queue. May be called from any thread."""
        known = list(self._coordinators.values())
        return {
            "search": sum(c.waiting_searches for c in known),
            "verify": sum(c.pending_loops for c in known),
        }

    def dismiss_watchers(self) -> None:
        """End the streams that would otherwise go on for ever."""
        for coordinator in self._coordinators.values():
            coordinator.board.close()

    async def close(self) -> None:
        """Stop every coordinator."""
        for coordinator in self._coordinators.values():
            await coordinator.close()

    def live(self) -> list[SessionCoordinator]:
        """The coordinators of all sessions."""
        return list(self._coordinators.values())

    async def coordinator(self, session: SessionRow) -> SessionCoordinator:
        """A session's coordinator; the session must be in the store."""
        async with self._lock:
            found = self._coordinators.get(session.name)
            if found is None:
                # It may have been deleted while the lock was held.
                stored = await self._store.agents.session(session.name)
                found = SessionCoordinator(
                    stored,
                    self._store,
                    jobs=self._jobs,
                    threads=self._threads,
                    config=self._config,
                    metrics=self._metrics,
                )
                late = self._late.setdefault(session.name, [])
                try:
                    await found.start()
                finally:
                    del self._late[session.name]
                self._coordinators[session.name] = found
                for vertex in late:
                    if vertex.name not in found.graph:
                        found.submap_stored(vertex)
            return found

    def found(self, session: str) -> SessionCoordinator | None:
        """The coordinator of a session's id that is at work, or None."""
        return self._coordinators.get(session)

    async def dismiss(self, session: int, reason: MagicError) -> SessionRow | None:
        """Work no more on a session, by row id; those who watch it are sent away with `reason`."""
        async with self._lock:
            for name, found in self._coordinators.items():
                if found.session.id == session:
                    del self._coordinators[name]
                    await found.close()
                    found.board.close(reason)
                    return found.session
        return None

    @asynccontextmanager
    async def forgotten(self, session: SessionRow, reason: MagicError) -> AsyncIterator[None]:
        """While the block deletes a session from the store nobody works on it.

        Those who watch it are sent away with `reason`.
        """
        async with self._lock:
            found = self._coordinators.pop(session.name, None)
            if found is not None:
                await found.close()
            try:
                yield
            except BaseException:
                if found is not None:
                    found.board.close()  # it was not deleted: watchers come back to a new one
                raise
            if found is not None:
                found.board.close(reason)

    def submap_stored(self, agent: AgentRow, vertex: Vertex) -> None:
        """Tell the session's coordinator of a sub-map that is durable."""
        # Without one its session is being deleted, or begun again once that has failed.
        if found := self._coordinators.get(agent.session.name):
            found.submap_stored(vertex)
        elif agent.session.name in self._late:
            self._late[agent.session.name].append(vertex)

    async def named(self, session: str) -> SessionCoordinator:
        """The coordinator of a session's id; NotFound when there is no such session."""
        found = self._coordinators.get(session)
        return found or await self.coordinator(await self._store.agents.session(session))


def _load_libraries(config: ServerConfig) -> None:
    """Load what the first sub-map and the first verdict need: later it would hold up the loop."""
    DescriptorIndex(1)
    SessionGraph("", config.posegraph)
    importlib.import_module("magic_server.registration.register")
