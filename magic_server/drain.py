"""The gate that every call passes: closed before the server is ready and while it drains."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from typing import Literal

from magic_core.errors import Overloaded, Unavailable

State = Literal["starting", "open", "draining"]
RETRY_S = 1.0
"""How long a caller is asked to wait before it tries again."""


class Gate:
    """Counts the calls under way, refuses new ones when there are too many or none are wanted."""

    def __init__(self, *, max_calls: int, max_watches: int) -> None:
        self.state: State = "starting"
        self.calls = 0
        self.watches = 0
        self._max_calls = max_calls
        self._max_watches = max_watches
        self._changed = asyncio.Event()

    @property
    def ready(self) -> bool:
        """Whether calls are taken."""
        return self.state == "open"

    def open(self) -> None:
        """Everything is loaded: take calls."""
        self.state = "open"

    def drain(self) -> None:
        """Take no more calls; those under way go on."""
        self.state = "draining"

    @contextlib.contextmanager
    def passing(self, *, watch: bool = False) -> Iterator[None]:
        """Holds a place for one call. Raises Unavailable or Overloaded instead of entering."""
        if self.state != "open":
            doing = "starting" if self.state == "starting" else "stopping"
            raise Unavailable(f"the server is {doing}; try again", retry_after_s=RETRY_S)
        self._require_place(watch=watch)
        self._count(1, watch=watch)
        try:
            yield
        finally:
            self._count(-1, watch=watch)

    async def empty(self, timeout_s: float) -> bool:
        """Wait until no call is under way, watches apart; False when that took too long."""
        try:
            async with asyncio.timeout(timeout_s):
                while self.calls:
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            return False
        return True

    def _require_place(self, *, watch: bool) -> None:
        held, most = (self.watches, self._max_watches) if watch else (self.calls, self._max_calls)
        if held >= most:
            what = "watches" if watch else "calls"
            raise Overloaded(
                f"{held} {what} are under way, this server takes {most} at once",
                retry_after_s=RETRY_S,
            )

    def _count(self, change: int, *, watch: bool) -> None:
        if watch:
            self.watches += change
        else:
            self.calls += change
            self._changed.set()
