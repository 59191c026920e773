"""The C library's memory: what a server is done with goes back to the system.

glibc gives each thread a pool of its own, up to eight for each processor, and none of them shrinks
by itself; a server that takes megabytes on many threads would seem to grow for hours.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
from collections.abc import AsyncIterator
from typing import Any

from magic_server.tasks import TaskScope

TRIM_EVERY_S = 10.0
_ARENA_MAX, _MMAP_THRESHOLD = -8, -3  # of malloc.h
_POOLS = 2
_OWN_PAGES_FROM = 256 << 10
"""Blocks of so many bytes get pages of their own, which go back as soon as they are free."""


def _library() -> Any | None:
    """glibc, or None where the C library is another one."""
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") and hasattr(library, "mallopt") else None


def keep_few_pools() -> None:
    """For the threads that are still to come. Affects the whole process."""
    if (library := _library()) is not None:
        library.mallopt(_ARENA_MAX, _POOLS)
        library.mallopt(_MMAP_THRESHOLD, _OWN_PAGES_FROM)


def trim() -> None:
    """Give free pages back; takes about a millisecond, without the interpreter lock."""
    if (library := _library()) is not None:
        library.malloc_trim(0)


@contextlib.asynccontextmanager
async def trimmed(every_s: float = TRIM_EVERY_S) -> AsyncIterator[None]:
    """While the block runs free pages are given back from time to time."""
    scope = TaskScope("memory")
    scope.start(_trim_for_ever(every_s), name="trimming")
    try:
        yield
    finally:
        await scope.close()


async def _trim_for_ever(every_s: float) -> None:
    while True:
        await asyncio.sleep(every_s)
        await asyncio.to_thread(trim)
