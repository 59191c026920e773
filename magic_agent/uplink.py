"""Sends finished sub-maps to the server while the agent carries on.

A sub-map first goes to the spool on disk; it leaves the spool only when the server has
acknowledged it, which means that the server has it on its own disk. A server that is away for a
while therefore costs nothing but time.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from magic_agent.client import MagicClient
from magic_agent.config import UplinkConfig
from magic_agent.resume import ResumeState
from magic_agent.spool import Spool
from magic_core.errors import DeadlineExceeded, MagicError, ResourceExhausted, Unavailable
from magic_core.evaluation import WireBytes
from magic_core.submap import Submap
from magic_core.wire import SubmapEncoding, encode_submap
from magic_core.wire.records import SubmapReceipt

log = logging.getLogger(__name__)

QUEUE_SUBMAPS = 2
"""Finished sub-maps that wait to be encoded; when there are more, mapping waits for the disk."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A finished sub-map, and where the agent goes on behind it."""

    submap: Submap
    state: ResumeState
    """Its `wire_bytes` are those of an earlier process; the uplink adds its own."""


class Uplink:
    """Encodes, spools and streams one agent's sub-maps in order, each until it is acknowledged."""

    def __init__(
        self,
        client: MagicClient,
        spool: Spool,
        *,
        config: UplinkConfig,
        executor: Executor,
        on_spooled: Callable[[int, WireBytes], None],
        on_receipt: Callable[[int, SubmapReceipt], None],
        completed: Callable[[Submap], Submap] = lambda submap: submap,
    ) -> None:
        """`completed` is called on the executor before a sub-map is encoded: what may be added to
        it then does not hold up tracking."""
        self._client = client
        self._spool = spool
        self._config = config
        self._executor = executor
        self._on_spooled = on_spooled
        self._on_receipt = on_receipt
        self._completed = completed
        self._finished: asyncio.Queue[Finished | None] = asyncio.Queue(QUEUE_SUBMAPS)
        # What an earlier process left may be on the server in part.
        self._left_over = frozenset(spool.pending())
        self._spooled = asyncio.Event()
        self._closed = False
        self._spooled_sizes: list[WireBytes] = []

    async def put(self, finished: Finished) -> None:
        """Take a finished sub-map; returns at once while the queue has room."""
        await self._finished.put(finished)

    async def close(self) -> None:
        """No more sub-maps will come; `run` returns once the last is acknowledged."""
        await self._finished.put(None)

    async def run(self) -> None:
        """Encode and send until closed and drained. Raises what the server refuses for good."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._store_all())
            group.create_task(self._send_all())

    async def _store_all(self) -> None:
        loop = asyncio.get_running_loop()
        while (finished := await self._finished.get()) is not None:
            sizes = await loop.run_in_executor(self._executor, self._encode_and_store, finished)
            self._on_spooled(finished.submap.index, sizes)
            self._spooled.set()
        self._closed = True
        self._spooled.set()

    def _encode_and_store(self, finished: Finished) -> WireBytes:
        """Both encodings are made, so that every report can say what the codec saves."""
        submap = self._completed(finished.submap)
        request_id = f"{submap.agent}-{submap.index}-{uuid.uuid4().hex}"
        compact = encode_submap(submap, request_id=request_id)
        lossless = encode_submap(submap, request_id=request_id, encoding=SubmapEncoding.lossless())
        sizes = WireBytes(compact=compact.wire_bytes, lossless=lossless.wire_bytes)
        state = finished.state
        state = replace(state, wire_bytes=(*state.wire_bytes, *self._spooled_sizes, sizes))
        self._spooled_sizes.append(sizes)
        chosen = lossless if self._config.lossless else compact
        self._spool.add(submap.index, chosen, state=state)
        return sizes

    async def _send_all(self) -> None:
        while True:
            for index in self._spool.pending():
                await self._send(index)
            if self._closed and not self._spool.pending():
                return
            await self._spooled.wait()
            self._spooled.clear()

    async def _send(self, index: int) -> None:
        loop = asyncio.get_running_loop()
        encoded = await loop.run_in_executor(self._executor, self._spool.load, index)
        delay_s, waited_s, repeated = self._config.first_retry_s, 0.0, False
        while True:
            try:
                resume = repeated or index in self._left_over
                receipt = await self._client.submit_encoded(encoded, resume=resume)
                break
            except (Unavailable, DeadlineExceeded, ResourceExhausted) as error:
                if waited_s >= self._config.give_up_after_s or _is_final(error):
                    raise
                pause_s = max(delay_s, error.retry_after_s or 0.0)
                log.warning("sub-map %d waits %.1f s: %s", index, pause_s, error)
            await asyncio.sleep(pause_s)
            repeated = True
            waited_s += pause_s if self._closed else 0.0
            delay_s = min(2 * delay_s, self._config.longest_retry_s)
        await loop.run_in_executor(self._executor, self._spool.remove, index)
        self._on_receipt(index, receipt)


def _is_final(error: MagicError) -> bool:
    """Whether waiting is no use: the server names a limit, and no time after which it passes."""
    return isinstance(error, ResourceExhausted) and error.retry_after_s is None
