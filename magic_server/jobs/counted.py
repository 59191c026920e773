"""What the engines share: each open job is counted and has its span in the trace."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

from magic_core import tracing

T = TypeVar("T")


class CountedJobs(ABC):
    """An engine that knows how many of its jobs have no answer yet."""

    def __init__(self) -> None:
        self._open = 0

    @property
    @abstractmethod
    def slots(self) -> int:
        """How many jobs could run at once now."""

    @property
    def waiting(self) -> int:
        """Jobs that wait for a worker."""
        return max(0, self._open - self.slots)

    async def run(self, function: Callable[..., T], /, *arguments: Any) -> T:
        """The function's result, or the error it raised. Unavailable when workers died of it."""
        name = getattr(function, "__name__", str(function))
        self._open += 1
        try:
            with tracing.span(f"job {name}"):
                return await self._run(name, function, *arguments)
        finally:
            self._open -= 1

    @abstractmethod
    async def _run(self, name: str, function: Callable[..., T], *arguments: Any) -> T: ...
