"""What a server does from time to time: dropping files that nobody will ask for again."""

from __future__ import annotations

import asyncio
import logging
import time
from concurrent.futures import Executor

from magic_core.errors import Unavailable
from magic_server.store import Store
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)


class Upkeep:
    """Collects blobs that nothing refers to, and uploads that nobody went on with."""

    def __init__(self, store: Store, *, threads: Executor, interval_s: float) -> None:
        self._store = store
        self._threads = threads
        self._interval_s = interval_s
        self._tasks = TaskScope("upkeep")

    def start(self) -> None:
        """Begin; the store has just been tidied by its start, a bucket is now."""
        self._tasks.start(self._for_ever(), name="tidying")

    async def close(self) -> None:
        """Stop."""
        await self._tasks.close()

    async def tidy(self) -> tuple[int, int]:
        """(blobs, uploads) that were removed."""
        prune = self._store.uploads.prune
        loop = asyncio.get_running_loop()
        uploads = await loop.run_in_executor(self._threads, lambda: prune(now=time.time()))
        return await self._store.collect_orphans(), uploads

    async def _for_ever(self) -> None:
        wait = not self._store.blobs.far
        while True:
            await asyncio.sleep(self._interval_s if wait else 0.0)
            wait = True
            try:
                blobs, uploads = await self.tidy()
            except Unavailable as error:
                logger.warning("not tidied: %s; tried again in %g s", error, self._interval_s)
                continue
            except Exception:
                logger.exception("tidying failed; it is tried again in %g s", self._interval_s)
                continue
            if blobs or uploads:
                logger.info("removed %d blobs and %d uploads that were left", blobs, uploads)
