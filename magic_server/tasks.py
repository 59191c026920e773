"""Background tasks that belong to something and end with it."""

from __future__ import annotations

import asyncio
import contextvars
import logging
from collections.abc import Coroutine
from typing import Any, TypeVar

logger = logging.getLogger(__name__)
T = TypeVar("T")


class TaskScope:
    """Tasks with one owner: none is lost, a failed one is logged, closing ends them all."""

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._tasks: set[asyncio.Task[Any]] = set()
        self._closed = False

    def start(
        self, work: Coroutine[Any, Any, T], *, name: str, detached: bool = False
    ) -> asyncio.Task[T]:
        """Run a coroutine in the background.

        A detached one does not carry on the trace and the log ids of the call that began it.
        """
        if self._closed:
            work.close()
            raise asyncio.CancelledError(f"{self._owner} is closed")
        context = contextvars.Context() if detached else None
        task = asyncio.create_task(work, name=f"{self._owner}: {name}", context=context)
        self._tasks.add(task)
        task.add_done_callback(self._forget)
        return task

    async def finish(self) -> None:
        """Take no more tasks and wait for the end of each."""
        self._closed = True
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def close(self) -> None:
        """Cancel every task and wait for the end of each."""
        self._closed = True
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _forget(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("task %r failed", task.get_name(), exc_info=error)
