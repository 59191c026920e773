"""Which sessions this server works on, where several share the database.

A session is worked on by the server that holds its lease (store/leases.py). A call about a session
comes to its holder, or is answered with the holder's address; a session that nobody holds goes to
the server that is asked, or to the first that notices. All of a session's work hangs on the lease:
its searches, verifications, solves and merges are begun from the store by whoever takes it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import time
from collections import defaultdict

from magic_core.errors import HeldElsewhere, InvalidInput, MagicError, NotFound
from magic_core.wire import names
from magic_server.cluster_config import ClusterConfig
from magic_server.globalmaps import GlobalMaps
from magic_server.sessions import Sessions
from magic_server.store import LeaseTable, SessionRow, Store
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

LOOK_S = 1.0
"""How often sessions are looked for that nobody holds."""
BATCH = 16
RENEWALS = 4
"""So many times a lease is renewed before it would end."""
REST_S = 60.0
"""A session that could not be begun is left alone for so long."""

_SESSIONS = "/magicslam.v1.SessionService/"
_MAPS = "/magicslam.v1.GlobalMapService/"
ANY_SERVER = frozenset(
    [_SESSIONS + name for name in ("GetSession", "GetAgent", "ListAgents", "GetSubmap")]
    + [_SESSIONS + name for name in ("ListSubmaps", "DownloadSubmap", "ExportSession")]
    + [_MAPS + name for name in ("GetOperation", "ListOperations")]
)
"""Calls that are answered from the store alone."""


class Leasing:
    """Takes sessions, keeps them while it can, and lets go of those that are lost."""

    def __init__(
        self,
        leases: LeaseTable,
        *,
        store: Store,
        sessions: Sessions,
        maps: GlobalMaps,
        config: ClusterConfig,
    ) -> None:
        self._leases = leases
        self._store = store
        self._sessions = sessions
        self._maps = maps
        self._config = config
        self._until: dict[int, float] = {}  # by the monotonic clock
        self._locks: defaultdict[int, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._left_alone: dict[int, float] = {}
        self._looking = TaskScope("free sessions")
        self._renewing = TaskScope("leases")

    async def start(self, address: str) -> None:
        """Take every session that is free; clients find this server at an address."""
        self._leases.begin(address=address, lease_s=self._config.lease_s)
        self._renewing.start(self._renew_for_ever(), name="renew")
        while await self._take_free():
            pass
        self._looking.start(self._look_for_ever(), name="look")

    async def stop_taking(self) -> None:
        """Take no more sessions; those that are held are kept."""
        await self._looking.close()

    async def close(self) -> None:
        """Let the other servers have everything at once."""
        await self._looking.close()
        await self._renewing.close()
        with contextlib.suppress(MagicError):  # they have it when the leases end
            await self._leases.release()

    async def route(self, method: str, resource: str) -> None:
        """Raise HeldElsewhere where a call about a resource belongs to another server."""
        if method in ANY_SERVER:
            return
        try:
            name = names.session_of(resource)
        except InvalidInput:
            return  # the call itself says what is wrong with it
        live = self._sessions.found(name)
        if live is not None and self._until.get(live.session.id, 0.0) > time.monotonic():
            return
        session = await self._store.agents.find(name)
        if session is not None:
            await self._take(session)

    async def _take(self, session: SessionRow) -> None:
        """Hold a session and work on it. HeldElsewhere, NotFound where that cannot be."""
        async with self._locks[session.id]:
            asked = time.monotonic()
            if self._until.get(session.id, 0.0) > asked and self._sessions.found(session.name):
                return
            await self._leases.take(session)
            try:
                known = self._sessions.found(session.name) is not None
                await self._sessions.coordinator(session)
                if not known:
                    await self._maps.resume(session)
                    logger.info("%s: taken up", session.name)
            except BaseException:
                await self._leases.release([session.id])
                raise
            self._until[session.id] = asked + self._config.lease_s

    async def _take_free(self) -> int:
        """Take some of the sessions that nobody holds; returns how many."""
        now, taken = time.monotonic(), 0
        for session in await self._leases.free(BATCH):
            if self._left_alone.get(session.id, 0.0) > now:
                continue
            try:
                await self._take(session)
                taken += 1
            except (HeldElsewhere, NotFound):
                continue
            except Exception:
                logger.exception("%s cannot be taken up; it is tried again later", session.name)
                self._left_alone[session.id] = now + REST_S
        return taken

    async def _look_for_ever(self) -> None:
        while True:
            # Not all servers in the same instant: then each gets some.
            await asyncio.sleep(LOOK_S * random.uniform(0.5, 1.5))
            try:
                await self._take_free()
            except MagicError as error:
                logger.warning("looking for free sessions: %s", error)
            except Exception:
                logger.exception("looking for free sessions failed")

    async def _renew_for_ever(self) -> None:
        while True:
            await asyncio.sleep(self._config.lease_s / RENEWALS)
            try:
                await self._renew()
            except MagicError as error:
                logger.warning("leases are not renewed: %s", error)
            except Exception:
                logger.exception("renewing leases failed")
            now = time.monotonic()
            for session in [one for one, until in self._until.items() if until <= now]:
                await self._drop(session)

    async def _renew(self) -> None:
        asked = time.monotonic()
        kept, lost = await self._leases.renew()
        for session in kept & self._until.keys():
            self._until[session] = asked + self._config.lease_s
        for session in lost:
            await self._drop(session)

    async def _drop(self, session: int) -> None:
        """Work no more on a session: another server has it, or may have it by now."""
        async with self._locks[session]:
            self._leases.forget(session)
            self._until.pop(session, None)
            # First: what it lacks without the rest of the session would be taken for a failure.
            await self._maps.hand_on(session)
            moved = HeldElsewhere("the session has moved to another server; ask again")
            dropped = await self._sessions.dismiss(session, moved)
            if dropped is not None:
                logger.warning("%s: its lease was lost", dropped.name)
