"""What a session's coordinator asks of an index, wherever it is kept."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import numpy as np

from magic_server.places.hits import Hit, Place
from magic_server.places.index import DescriptorIndex


class Places(Protocol):
    """The descriptors of one session's sub-maps."""

    async def open(self) -> None:
        """Be ready for everything else."""
        ...

    async def load(self, places: Sequence[Place]) -> None:
        """Hold these too; they come page by page when a session is begun."""
        ...

    async def add(self, place: Place) -> None:
        """Hold one more; nothing happens when it is there."""
        ...

    async def remove(self, names: Collection[str]) -> None:
        """Forget some; unknown ones are ignored."""
        ...

    async def nearest(self, vectors: np.ndarray, count: int) -> list[Hit]:
        """The sub-maps nearest to one of the vectors (n, d), each once with its best similarity,
        best first, ties by age."""
        ...


class LocalPlaces:
    """An index on FAISS in this process."""

    def __init__(self, dimension: int, threads: Executor) -> None:
        self._index = DescriptorIndex(dimension)
        self._threads = threads
        self._lock = asyncio.Lock()

    async def open(self) -> None:
        """Nothing to do."""

    async def load(self, places: Sequence[Place]) -> None:
        """Hold these too; AlreadyExists when one is there."""
        async with self._lock:
            await self._in_thread(self._index.load, places)

    async def add(self, place: Place) -> None:
        """Hold one more; nothing happens when it is there."""
        async with self._lock:
            if place.name not in self._index:
                await self._in_thread(self._index.add, place)

    async def remove(self, names: Collection[str]) -> None:
        """Forget some; unknown ones are ignored."""
        async with self._lock:
            await self._in_thread(_forget, self._index, names)

    async def nearest(self, vectors: np.ndarray, count: int) -> list[Hit]:
        """The sub-maps nearest to one of the vectors (n, d), each once with its best similarity,
        best first, ties by age."""
        async with self._lock:
            return await self._in_thread(self._index.query, vectors, count)

    async def _in_thread(self, function: Any, *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _forget(index: DescriptorIndex, names: Collection[str]) -> None:
    for name in names:
        if name in index:
            index.remove(name)
