"""Parts of maps as files: made in a worker, kept for a while, and never more than a bound of them.

A region of a map, or the map in less detail, is made from the map's lossless file when somebody
asks for it. The same part of the same map is the same file, so whoever asks again, perhaps because
the download broke, gets the bytes of before.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import time
import uuid
from collections.abc import AsyncIterator
from concurrent.futures import Executor
from dataclasses import dataclass, field

from magicslam.v1 import submap_pb2

from magic_core.errors import DeadlineExceeded, Overloaded
from magic_core.gaussians.region import Region
from magic_core.wire import records
from magic_server.excerpt_config import ExcerptConfig
from magic_server.jobs import JobExecutor
from magic_server.jobs.delivery import Deliveries, Delivery, OpenFile
from magic_server.jobs.excerpts import ExcerptOutcome, ExcerptTask, make_excerpt
from magic_server.sending import open_chunks
from magic_server.store import Store
from magic_server.store.blob_store import StreamedFile
from magic_server.tasks import TaskScope

_FOLDER = "excerpts"
RETRY_S = 2.0
"""How long callers are asked to wait for others to end their downloads."""


@dataclass(frozen=True, slots=True)
class ExcerptKey:
    """A part of a map. What is made of equal ones is equal to the bit."""

    session: int
    sha256: str
    """Of the map's lossless file."""
    kind: records.MapFormat
    region: Region | None
    max_gaussians: int


@dataclass(slots=True)
class _Entry:
    """A file that is there, or being made."""

    delivery: Delivery
    made: ExcerptOutcome | None = None
    users: int = 0
    used_at: float = field(default_factory=time.monotonic)
    making: asyncio.Task[ExcerptOutcome | Exception] | None = None
    """The newest try at it, for which all who want it wait."""


class _Use:
    """Somebody's use of a file; it ends once."""

    def __init__(self, entry: _Entry) -> None:
        self.entry = entry
        self.ended = False
        entry.users += 1

    def end(self) -> None:
        """The file is no longer needed."""
        if not self.ended:
            self.ended = True
            self.entry.users -= 1
            self.entry.used_at = time.monotonic()


class Excerpts:
    """The parts of maps that a server has on its disk, those asked for last at the end."""

    def __init__(
        self, store: Store, *, jobs: JobExecutor, threads: Executor, config: ExcerptConfig
    ) -> None:
        self._jobs, self._threads, self._config = jobs, threads, config
        self._root = store.scratch / _FOLDER
        self._deliveries = Deliveries(store, shares_folder=jobs.shares_folder)
        self._entries: dict[ExcerptKey, _Entry] = {}
        self._tasks = TaskScope("excerpts")

    async def start(self) -> None:
        """Drop what an earlier server left."""
        await self._in_thread(shutil.rmtree, self._root, True)
        self._tasks.start(self._for_ever(), name="tidying")

    async def close(self) -> None:
        """Stop."""
        await self._tasks.close()

    async def forget(self, session: int) -> None:
        """Remove what shows a session that is being deleted, each once nobody reads it."""
        mine = [key for key in self._entries if key.session == session]
        for entry in [self._entries.pop(key) for key in mine]:
            await self._clear_unused(entry)

    @contextlib.asynccontextmanager
    async def opened(
        self, key: ExcerptKey, source: StreamedFile
    ) -> AsyncIterator[tuple[ExcerptOutcome, AsyncIterator[submap_pb2.BlobChunk]]]:
        """What a part is, and its chunks; made now where it is not there.

        Overloaded while all places are in use; Unavailable without workers.
        """
        use, removed = self._use_of(key)
        try:
            if removed is not None:
                await self._in_thread(removed.delivery.clear)
            made = await self._made(use.entry, key, source)
            file = await self._in_thread(self._deliveries.opened, made.file)
            try:
                yield made, self._chunks(file, use)
            finally:
                file.close()
        finally:
            use.end()
            await asyncio.shield(self._tidy(key, use.entry))

    def _use_of(self, key: ExcerptKey) -> tuple[_Use, _Entry | None]:
        """A part's place, which stays while it is in use, and what had to go for it."""
        removed = None
        entry = self._entries.pop(key, None)
        if entry is None:
            removed = self._make_room()
            entry = _Entry(self._deliveries.of(self._root / uuid.uuid4().hex))
        self._entries[key] = entry  # at the end: it was asked for last
        return _Use(entry), removed

    def _make_room(self) -> _Entry | None:
        if len(self._entries) < self._config.most:
            return None
        oldest = next((key for key, entry in self._entries.items() if not entry.users), None)
        if oldest is None:
            raise Overloaded(
                f"{len(self._entries)} parts of maps are being made or sent, this server does no "
                "more at a time; try again later",
                retry_after_s=RETRY_S,
            )
        return self._entries.pop(oldest)

    async def _made(self, entry: _Entry, key: ExcerptKey, source: StreamedFile) -> ExcerptOutcome:
        if entry.made is not None:
            return entry.made
        if entry.making is None or entry.making.done():
            task = ExcerptTask(source, key.region, key.max_gaussians, key.kind, entry.delivery)
            entry.making = self._tasks.start(self._make(_Use(entry), key, task), name="making")
        found = await asyncio.shield(entry.making)
        if isinstance(found, Exception):
            raise found
        return found

    async def _make(
        self, use: _Use, key: ExcerptKey, task: ExcerptTask
    ) -> ExcerptOutcome | Exception:
        """Goes on when nobody waits any more: a worker that has begun does not stop, and what it
        leaves would lie there unknown."""
        try:
            use.entry.made = await self._jobs.run(make_excerpt, task)
            return use.entry.made
        except Exception as error:  # those who wait raise it
            return error
        finally:
            use.end()
            await self._tidy(key, use.entry)

    async def _tidy(self, key: ExcerptKey, entry: _Entry) -> None:
        """Remove what was not made, what is no longer wanted, and what is beyond the bound."""
        if entry.made is None and not entry.users and self._entries.get(key) is entry:
            del self._entries[key]
        if self._entries.get(key) is not entry:
            await self._clear_unused(entry)
        while (oldest := self._beyond_the_bound()) is not None:
            await self._clear_unused(self._entries.pop(oldest))

    async def _for_ever(self) -> None:
        """Remove what nobody has asked for in a while."""
        while True:
            await asyncio.sleep(self._config.kept_s / 4)
            end = time.monotonic() - self._config.kept_s
            old = [k for k, e in self._entries.items() if not e.users and e.used_at < end]
            for entry in [self._entries.pop(key) for key in old]:
                await self._clear_unused(entry)

    def _beyond_the_bound(self) -> ExcerptKey | None:
        """The part to remove next, None where there is room for all."""
        made = [entry.made.length for entry in self._entries.values() if entry.made is not None]
        if sum(made) <= self._config.kept_bytes:
            return None
        unused = (key for key, entry in self._entries.items() if not entry.users)
        return next(unused, None)

    async def _clear_unused(self, entry: _Entry) -> None:
        if not entry.users:
            await self._in_thread(entry.delivery.clear)

    async def _chunks(self, file: OpenFile, use: _Use) -> AsyncIterator[submap_pb2.BlobChunk]:
        def give_up() -> None:
            use.end()
            file.close()

        loop, idle_s = asyncio.get_running_loop(), self._config.idle_s
        async for chunk in open_chunks(file, self._threads):
            timer = loop.call_later(idle_s, give_up)
            try:
                yield chunk
            finally:
                timer.cancel()
            if use.ended:
                raise DeadlineExceeded(
                    f"the download took nothing for {idle_s:g} s; ask for it again"
                )

    async def _in_thread(self, function, *arguments):
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)
