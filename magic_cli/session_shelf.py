"""The sessions of a server, or of a store's folder, behind one set of calls."""

from __future__ import annotations

import dataclasses
import time
import uuid
from collections.abc import AsyncIterable, AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Protocol

from magic_core.errors import ConfigError, NotFound
from magic_core.wire import SubmapLimits, names, records

if TYPE_CHECKING:
    from magic_agent.client import MagicClient
    from magic_cli.sessions import Place
    from magic_server.store import Store

Shown = tuple[records.SessionInfo, tuple[records.AgentInfo, ...]]


class Shelf(Protocol):
    """What can be done with sessions. Errors are those of the server."""

    async def list(self) -> tuple[records.SessionInfo, ...]: ...
    async def show(self, session: str) -> Shown: ...
    async def delete(self, name: str, *, force: bool) -> records.Deletion: ...
    def export(self, session: str) -> AsyncIterator[bytes]: ...
    async def import_(
        self, pieces: AsyncIterable[bytes], *, request_id: str
    ) -> records.SessionInfo: ...


@asynccontextmanager
async def opened(place: Place) -> AsyncIterator[Shelf]:
    """The sessions at a place; WrongState for a folder that a server has open."""
    if place.data_dir is None:
        from magic_agent.client import ClientConfig, MagicClient

        config = ClientConfig(
            credentials=place.credentials, download_timeout_s=place.timeout_s, rpc_timeout_s=60.0
        )
        async with MagicClient(place.server, config) as client:
            yield ServerShelf(client)
        return
    from magic_server.store import Store

    if not (place.data_dir / "magic.sqlite").is_file() and not _may_begin(place):
        raise NotFound(f"{place.data_dir}: no store here; expected magic.sqlite in it")
    with ThreadPoolExecutor(2) as threads:
        async with Store(place.data_dir, threads) as store:
            yield FolderShelf(store, threads)


def _may_begin(place: Place) -> bool:
    from magic_cli.sessions import ImportCommand

    return isinstance(place, ImportCommand)


class ServerShelf:
    """The sessions of a running server."""

    def __init__(self, client: MagicClient) -> None:
        self._client = client

    async def list(self) -> tuple[records.SessionInfo, ...]:
        """Every session, oldest first."""
        return await self._client.list_sessions()

    async def show(self, session: str) -> Shown:
        """A session and its agents."""
        info = await self._client.get_session(session)
        return info, await self._client.list_agents(session)

    async def delete(self, name: str, *, force: bool) -> records.Deletion:
        """Delete a session, an agent or a sub-map."""
        if "/submaps/" in name:
            return await self._client.delete_submap(name, force=force)
        if "/agents/" in name:
            return await self._client.delete_agent(*names.parse_agent(name), force=force)
        return await self._client.delete_session(name.removeprefix("sessions/"), force=force)

    def export(self, session: str) -> AsyncIterator[bytes]:
        """A session's archive."""
        return self._client.export_session(session)

    async def import_(
        self, pieces: AsyncIterable[bytes], *, request_id: str
    ) -> records.SessionInfo:
        """Store the session of an archive."""
        return await self._client.import_session(pieces, request_id=request_id)


class FolderShelf:
    """The sessions of a store that no server has open."""

    def __init__(self, store: Store, threads: ThreadPoolExecutor) -> None:
        from magic_server.archive import Archives

        self._store = store
        self._archives = Archives(store, threads=threads, limits=SubmapLimits())

    async def list(self) -> tuple[records.SessionInfo, ...]:
        """Every session, oldest first."""
        found: list[records.SessionInfo] = []
        following: int | None = 0
        while following is not None:
            page, following = await self._store.agents.session_page(after=following)
            found += page
        return tuple(found)

    async def show(self, session: str) -> Shown:
        """A session and its agents."""
        row = await self._store.agents.session(session)
        info = await self._info(session)
        agents: list[records.AgentInfo] = []
        following: int | None = 0
        while following is not None:
            page, following = await self._store.agents.agent_page(row, after=following)
            agents += page
        return info, tuple(agents)

    async def delete(self, name: str, *, force: bool) -> records.Deletion:
        """Delete a session; agents and sub-maps need a server, which solves the graph again."""
        from magic_server.removal import require_finished_agents
        from magic_server.store import DeletionRequest

        if "/agents/" in name:
            raise ConfigError.field("name", f"{name}: only whole sessions without a server")
        full = name if name.startswith("sessions/") else names.session_name(name)
        row = await self._store.agents.session(names.parse_session(full))
        if not force:
            await require_finished_agents(self._store, row)
        request = DeletionRequest(full, uuid.uuid4().hex, time.time())
        deleted = await self._store.deletions.session(row, request)
        return records.Deletion(**dataclasses.asdict(deleted))

    def export(self, session: str) -> AsyncIterator[bytes]:
        """A session's archive."""
        return self._archives.export(session)

    async def import_(
        self, pieces: AsyncIterable[bytes], *, request_id: str
    ) -> records.SessionInfo:
        """Store the session of an archive."""
        return await self._archives.import_(pieces, request_id=request_id)

    async def _info(self, session: str) -> records.SessionInfo:
        (info,), _ = await self._store.agents.session_page(session=session)
        return info
