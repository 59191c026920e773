"""Sub-maps that wait at the same time are made durable together.

What a commit costs is waiting for the disk: each blob, each folder and the transaction. A round of
that takes hardly longer for many sub-maps than for one, so whoever comes while a round is under
way waits for the next, which takes all of them.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from magic_core.errors import HeldElsewhere, Unavailable
from magic_server.store.blob_store import BlobStore, WrittenBlob
from magic_server.store.commit_lock import CommitLock
from magic_server.store.rows import AgentRow, NewSubmap
from magic_server.store.submaps import Arrival, FirstAnswer, SubmapTable
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

MOST_TOGETHER = 64
"""Sub-maps of one round, so that a refusal or a failure does not wait for endlessly many others."""


@dataclass(slots=True, eq=False)
class _Waiting:
    """A sub-map whose sender waits for its answer."""

    arrival: Arrival
    written: Sequence[WrittenBlob]
    answer: asyncio.Future[FirstAnswer | None]

    @property
    def place(self) -> tuple[int, int]:
        return self.arrival.place

    @property
    def digests(self) -> set[str]:
        return {blob.sha256 for blob in self.written}

    def settle(self, first: FirstAnswer | None) -> None:
        """Tell the sender; `first` is what an earlier request was answered."""
        if not self.answer.done():  # nobody waits any more
            self.answer.set_result(first)

    def fail(self, error: Exception) -> None:
        """Tell the sender that nothing was stored, and why."""
        if not self.answer.done():
            self.answer.set_exception(error)


class SubmapCommits:
    """Makes sub-maps durable, those together that wait together."""

    def __init__(
        self, submaps: SubmapTable, blobs: BlobStore, *, lock: CommitLock, threads: Executor
    ) -> None:
        """`lock` keeps everybody else from relying on blobs that are taken back."""
        self._submaps = submaps
        self._blobs = blobs
        self._lock = lock
        self._threads = threads
        self._waiting: list[_Waiting] = []
        self._work = TaskScope("commits")
        self._working = False

    async def add(
        self, agent: AgentRow, submap: NewSubmap, written: Sequence[WrittenBlob], *, now: float
    ) -> FirstAnswer | None:
        """Make one sub-map durable: its blobs, then a transaction.

        Returns what was answered before when another request stored the same sub-map meanwhile.
        Nothing is left behind when it fails. A caller that is cancelled does not undo it.
        """
        await self._blobs.bring(written, self._threads)
        answer = asyncio.get_running_loop().create_future()
        self._waiting.append(_Waiting(Arrival(agent, submap, now), written, answer))
        if not self._working:
            self._working = True
            self._work.start(self._commit_all(), name="rounds", detached=True)
        return await answer

    async def close(self) -> None:
        """Wait for the commits under way."""
        await self._work.finish()

    async def _commit_all(self) -> None:
        try:
            while self._waiting:
                await self._round()
        finally:
            self._working = False
            for one in self._waiting:  # only when the server is torn down in the middle
                one.answer.cancel()

    async def _round(self) -> None:
        batch: list[_Waiting] = []
        try:
            async with self._lock:
                batch = self._take()
                await self._commit(batch)
        except asyncio.CancelledError:
            for one in batch:
                one.answer.cancel()
            raise
        except Exception as error:
            for one in batch or self._take():
                one.fail(error)

    def _take(self) -> list[_Waiting]:
        """Who takes part in the next round: of one sub-map that came twice only the first."""
        chosen: dict[tuple[int, int], _Waiting] = {}
        for one in self._waiting:
            if len(chosen) < MOST_TOGETHER:
                chosen.setdefault(one.place, one)
        taken = list(chosen.values())
        self._waiting = [one for one in self._waiting if one not in taken]
        return taken

    async def _commit(self, batch: list[_Waiting]) -> None:
        known = await self._submaps.first_answers([one.place for one in batch])
        for one in batch:
            if one.place in known:
                one.settle(known[one.place])
        fresh_ones = [one for one in batch if one.place not in known]
        if not fresh_ones:
            return
        written = [blob for one in fresh_ones for blob in one.written]
        fresh = await self._in_thread(self._blobs.adopt, written)
        failed = await self._inserted(fresh_ones)
        if failed:
            held = {digest for one in fresh_ones if one not in failed for digest in one.digests}
            lost = {digest for one in failed for digest in one.digests} - held
            await self._in_thread(self._blobs.remove, lost.intersection(fresh))
        # Senders go on in the order of their rows.
        for one in fresh_ones:
            if one in failed:
                one.fail(failed[one])
            else:
                one.settle(None)

    async def _inserted(self, batch: list[_Waiting]) -> dict[_Waiting, Exception]:
        """Refer to the blobs in one transaction; returns who failed, and why.

        When it does not take all of them each gets one of its own: nobody fails for another.
        """
        try:
            await self._submaps.insert([one.arrival for one in batch])
        except Exception as error:
            # A database that went away may have them all: to try again is up to the senders.
            away = isinstance(error, Unavailable) and not isinstance(error, HeldElsewhere)
            if len(batch) == 1 or away:
                return dict.fromkeys(batch, error)
            logger.info("a commit of %d sub-maps failed and is taken apart: %s", len(batch), error)
        else:
            return {}
        failed: dict[_Waiting, Exception] = {}
        for one in batch:
            failed |= await self._inserted([one])
        return failed

    async def _in_thread(self, function: Any, *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)
