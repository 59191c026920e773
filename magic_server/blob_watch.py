"""Whether a bucket answers: a server that cannot store what it is sent is not ready."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from magic_core.errors import MagicError
from magic_server.store import BlobStore
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

LOOK_S = 5.0
"""How long after one look the next begins."""


class BlobWatch:
    """Looks at the store's blobs from time to time, where they are far away."""

    def __init__(self, blobs: BlobStore, *, on_change: Callable[[], Awaitable[None]]) -> None:
        """`on_change` is awaited whenever `trouble` comes or goes."""
        self.trouble = ""
        """Why blobs can be neither read nor written now; empty while they can."""
        self._blobs = blobs
        self._on_change = on_change
        self._tasks = TaskScope("bucket")

    def start(self) -> None:
        """Begin; the store has just been opened."""
        if self._blobs.far:
            self._tasks.start(self._for_ever(), name="look")

    async def close(self) -> None:
        """Stop."""
        await self._tasks.close()

    async def _for_ever(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            # On a thread of its own: those of the server may all wait for the same bucket.
            found = await asyncio.to_thread(self._look)
            if bool(found) == bool(self.trouble):
                continue
            self.trouble = found
            if found:
                logger.warning("not ready: %s", found)
            else:
                logger.warning("ready again: the bucket answers")
            await self._on_change()

    def _look(self) -> str:
        try:
            self._blobs.check()
        except MagicError as error:
            return error.message
        return ""
