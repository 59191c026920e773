"""Back pressure: a bounded number of jobs at a time, the most urgent of the others next."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
from collections.abc import AsyncIterator


class PriorityGate:
    """Lets jobs through to workers that can run so many at once; for one event loop."""

    def __init__(self, most: int) -> None:
        """`most` are let through however many workers there are."""
        self._most = most
        self._slots = 0
        self._inside = 0
        self._order = itertools.count()
        self._waiting: list[tuple[int, int, int, asyncio.Future[None]]] = []

    @property
    def waiting(self) -> int:
        """How many wait outside."""
        return sum(not entry.done() for *_, entry in self._waiting)

    def set_slots(self, slots: int) -> None:
        """The workers can run so many at once from now on; whoever is inside already stays."""
        self._slots = slots
        self._let_in()

    def open(self) -> None:
        """Let everybody in: nothing is handed over any more."""
        self._most = 1 << 30
        self.set_slots(self._most)

    @contextlib.asynccontextmanager
    async def turn(self, priority: int, *, ahead: int) -> AsyncIterator[None]:
        """Wait for a turn, the highest priority first, equal ones in order; hold it for a block.

        It comes while less than `ahead` times as many as can run are inside.
        """
        entry = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (-priority, next(self._order), ahead, entry))
        self._let_in()
        try:
            await entry
            yield
        finally:
            if not entry.cancelled():  # it was let in, even where its owner went away meanwhile
                self._inside -= 1
                self._let_in()

    def _let_in(self) -> None:
        while self._waiting:
            *_, ahead, entry = self._waiting[0]
            if self._inside >= min(self._most, ahead * self._slots):
                return
            heapq.heappop(self._waiting)
            if not entry.done():  # whoever gave up waiting left a cancelled entry behind
                self._inside += 1
                entry.set_result(None)
