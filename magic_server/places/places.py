"""What a session's coordinator asks of an index, wherever it is kept."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import numpy as np

from magic_server.places.index import DescriptorIndex

Named = tuple[str, np.ndarray]
"""The resource name of a sub-map, and its descriptor (d,)."""


class Places(Protocol):
    """The descriptors of one session's sub-maps."""

    async def load(self, vectors: Sequence[Named]) -> None:
        """Hold these, and no others."""
        ...

    async def add(self, name: str, vector: np.ndarray) -> None:
        """Hold one more; nothing happens when it is there."""
        ...

    async def remove(self, names: Collection[str]) -> None:
        """Forget some; unknown ones are ignored."""
        ...

    async def nearest(self, vector: np.ndarray, count: int) -> list[tuple[str, float]]:
        """The nearest names with their cosine similarity, best first, ties by age."""
        ...


class LocalPlaces:
    """An index on FAISS in this process."""

    def __init__(self, dimension: int, threads: Executor) -> None:
        self._index = DescriptorIndex(dimension)
        self._threads = threads
        self._lock = asyncio.Lock()

    async def load(self, vectors: Sequence[Named]) -> None:
        """Hold these, and no others; the index must be new."""
        names = [name for name, _ in vectors]
        async with self._lock:
            await self._in_thread(self._index.load, names, [vector for _, vector in vectors])

    async def add(self, name: str, vector: np.ndarray) -> None:
        """Hold one more; nothing happens when it is there."""
        async with self._lock:
            if name not in self._index:
                await self._in_thread(self._index.add, name, vector)

    async def remove(self, names: Collection[str]) -> None:
        """Forget some; unknown ones are ignored."""
        async with self._lock:
            await self._in_thread(_forget, self._index, names)

    async def nearest(self, vector: np.ndarray, count: int) -> list[tuple[str, float]]:
        """The nearest names with their cosine similarity, best first, ties by age."""
        async with self._lock:
            return await self._in_thread(self._index.query, vector, count)

    async def _in_thread(self, function: Any, *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _forget(index: DescriptorIndex, names: Collection[str]) -> None:
    for name in names:
        if name in index:
            index.remove(name)
