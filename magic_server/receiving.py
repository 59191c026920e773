"""Taking in sub-maps: every rule checked, every byte hashed, nothing kept of what is refused.

A stream that breaks is no refusal: what came of it waits on disk for the next stream.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import Executor
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import submap_pb2

from magic_core.errors import (
    AlreadyExists,
    CorruptData,
    DeadlineExceeded,
    InvalidInput,
    MagicError,
    Unavailable,
    WrongState,
)
from magic_core.wire import check_blob, check_chunk, check_header, names
from magic_server.config import ServiceLimits
from magic_server.quotas import Quotas
from magic_server.store import (
    AgentRow,
    FirstAnswer,
    NewSubmap,
    PartialUpload,
    Store,
    UploadName,
    Vertex,
    require_model,
)
from magic_server.tasks import TaskScope

logger = logging.getLogger(__name__)

Messages = AsyncIterator[mapping_pb.SubmitSubmapRequest]
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Received:
    """The answer to an upload."""

    received_at: float
    stored_bytes: int
    duplicate: bool


@dataclass(frozen=True, slots=True)
class Resumption:
    """Where an upload goes on."""

    blob_index: int
    offset: int
    durable_bytes: int
    stored: bool


class SubmapReceiver:
    """Takes uploads, a bounded number at a time."""

    def __init__(
        self, store: Store, *, threads: Executor, limits: ServiceLimits, quotas: Quotas
    ) -> None:
        self._store = store
        self._quotas = quotas
        self._threads = threads
        self._limits = limits
        self._places = asyncio.Semaphore(limits.concurrent_uploads)
        self._claims: dict[str, _Claim] = {}
        self._background = TaskScope("uploads")

    async def close(self) -> None:
        """Wait for what must not be interrupted, whose callers may be gone already."""
        await self._background.finish()

    async def receive(
        self, messages: Messages, *, on_stored: Callable[[AgentRow, Vertex], None]
    ) -> tuple[str, Received]:
        """Take one upload; `on_stored` is called in the order in which sub-maps became durable."""
        async with self._places, AsyncExitStack() as room:
            header = await self._header(messages)
            name = UploadName(header.name, header.request_id)
            async with self._claimed(name) as claim:
                upload = await self._admitted(header, name, room)
                if isinstance(upload, FirstAnswer):
                    return header.name, _repeated(upload)
                await self._taken(upload, messages, claim)
                # A client that goes away must not interrupt the transaction.
                return header.name, await self._finish(self._commit(upload, on_stored))

    async def resumption(self, submap: str, request_id: str) -> Resumption:
        """Where an upload goes on; a stream of it that is still open ends.

        Raises NotFound for an unknown agent, AlreadyExists when another request stored the sub-map.
        """
        session, agent_id, index = names.parse_submap(submap, field="submap")
        agent = await self._store.agents.agent(session, agent_id)
        name = UploadName(submap, request_id)
        async with self._claimed(name):
            first = await self._store.submaps.first_answer(agent, index)
            if first is not None:
                _require_same_request(name, first)
                return Resumption(0, 0, first.stored_bytes, True)
            found = await self._in_thread(lambda: self._store.uploads.look(name, now=time.time()))
            return Resumption(*found, stored=False)

    @asynccontextmanager
    async def _claimed(self, name: UploadName) -> AsyncIterator[_Claim]:
        """While the block runs no other stream brings the same upload; one that does ends now.

        A connection that is lost may look alive here for a minute, and its client is back at once.
        """
        while (other := self._claims.get(name.key)) is not None:
            other.give_way()
            await other.released.wait()
        claim = self._claims[name.key] = _Claim()
        try:
            yield claim
        finally:
            del self._claims[name.key]
            claim.released.set()

    async def _header(self, messages: Messages) -> submap_pb2.SubmapHeader:
        first = await next_message(messages, self._limits.upload_idle_s)
        if first is None or first.WhichOneof("payload") != "header":
            raise InvalidInput.field("header", "the first message of an upload carries the header")
        await self._in_thread(check_header, first.header, self._limits.submap)
        return first.header

    async def _admitted(
        self, header: submap_pb2.SubmapHeader, name: UploadName, room: AsyncExitStack
    ) -> Upload | FirstAnswer:
        """The upload, its place held by `room`; the first answer when the sub-map is stored."""
        session, agent_id, index = names.parse_submap(header.name)
        agent = await self._store.agents.agent(session, agent_id)
        digest = await self._in_thread(_digest, header)
        first = await self._store.submaps.first_answer(agent, index)
        if first is not None:
            _require_same(name, digest, first)
            return first
        await self._require_admission(header, agent, index)
        length = sum(blob.length for blob in header.blobs)
        await room.enter_async_context(self._quotas.upload(agent, length, key=name.key))
        return await self._opened(Upload(agent, header, digest, self._store))

    async def _require_admission(
        self, header: submap_pb2.SubmapHeader, agent: AgentRow, index: int
    ) -> None:
        """Raise unless the agent may store this sub-map now."""
        session = agent.session.name
        if agent.finished:
            raise WrongState(f"{names.agent_name(session, agent.name)} has finished")
        other = await self._store.submaps.number_of_request(agent, header.request_id)
        if other is not None:
            raise AlreadyExists(
                f"request {header.request_id!r} stored "
                f"{names.submap_name(session, agent.name, other)}; each sub-map has its own id"
            )
        vector = header.image_descriptor.vector
        require_model(agent.session, header.image_descriptor.model_id, len(vector))
        if header.HasField("odometry"):
            previous = header.odometry.previous_index
            if await self._store.submaps.first_answer(agent, previous) is None:
                await self._store.agents.agent(session, agent.name)  # or it is gone itself
                name = names.submap_name(session, agent.name, previous)
                raise WrongState(f"odometry refers to {name}, which is not stored; submit it first")

    async def _opened(self, upload: Upload) -> Upload:
        try:
            await self._whole(upload.open)
        except asyncio.CancelledError:
            await self._finish(self._kept(upload.partial))
            raise
        return upload

    async def _taken(self, upload: Upload, messages: Messages, claim: _Claim) -> None:
        """Receive what is missing.

        A stream that breaks or ends early leaves what came, however that shows; a refusal leaves
        nothing.
        """
        claim.taking = asyncio.create_task(self._take(upload, messages))
        if claim.gave_way:  # asked for before there was anything to end
            claim.taking.cancel()
        try:
            await claim.taking
        except (DeadlineExceeded, _EndedEarly):
            await self._finish(self._kept(upload.partial))
            raise
        except asyncio.CancelledError:
            await self._finish(self._kept(upload.partial))
            if claim.gave_way:
                raise Unavailable("another stream of the same upload has taken over") from None
            raise
        except MagicError:
            await self._finish(self._in_thread(upload.partial.discard))
            raise
        except BaseException:  # gRPC's own, where a server stops while a caller goes away
            await self._finish(self._kept(upload.partial))
            raise

    async def _take(self, upload: Upload, messages: Messages) -> None:
        """Receive every chunk that is missing; raises unless all blobs are complete and right."""
        begun = False
        while not upload.complete or not begun:
            message = await self._message(messages)
            if message is None:
                break
            if message.WhichOneof("payload") != "chunk":
                raise InvalidInput.field("chunk", "expected a chunk after the header")
            await self._whole(upload.put, message.chunk, not begun)
            begun = True
        if not upload.complete:
            blob, offset = upload.partial.cursor.position
            raise _EndedEarly.field(
                "chunk",
                f"the upload ended early, at byte {offset} of blob {blob}; go on where ResumeUpload"
                " says, or send all of it again",
            )
        if begun and await self._message(messages) is not None:
            raise InvalidInput.field("chunk", "every blob is complete already")

    async def _kept(self, upload: PartialUpload) -> None:
        """Put an upload aside for its next stream; it is dropped where the disk refuses that."""
        try:
            await self._in_thread(lambda: self._store.uploads.keep(upload, now=time.time()))
        except (MagicError, OSError):
            logger.warning("%s: the part that came cannot be kept", upload.name.submap)
            await self._in_thread(upload.discard)

    async def _finish(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Run to the end whatever becomes of the caller, who keeps its claim until then."""
        return await _to_the_end(self._background.start(work, name="finishing"))

    async def _commit(
        self, upload: Upload, on_stored: Callable[[AgentRow, Vertex], None]
    ) -> Received:
        now = time.time()
        try:
            submap = await self._in_thread(upload.new_submap)
            blobs = upload.partial.blobs
            first = await self._store.add_submap(upload.agent, submap, blobs, now=now)
            if first is not None:
                _require_same(upload.partial.name, upload.partial.header_sha256, first)
                return _repeated(first)
            # No await in between: sub-maps are told of in the order of their transactions.
            on_stored(upload.agent, submap.vertex)
            return Received(now, sum(blob.length for blob in upload.header.blobs), False)
        finally:
            await self._in_thread(upload.partial.discard)

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)

    async def _whole(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Run on a thread; whoever is cancelled meanwhile waits for its end first."""
        work = asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)
        return await _to_the_end(work)

    async def _message(self, messages: Messages) -> mapping_pb.SubmitSubmapRequest | None:
        return await next_message(messages, self._limits.upload_idle_s)


class _EndedEarly(InvalidInput):
    """The messages ended before the blobs did.

    Nothing that came is wrong. gRPC also ends the messages of a connection that broke, and only
    then cancels the call, so that this may be all that is seen of a caller that vanished.
    """


class _Claim:
    """One stream's hold on an upload."""

    def __init__(self) -> None:
        self.taking: asyncio.Task[None] | None = None
        self.gave_way = False
        self.released = asyncio.Event()

    def give_way(self) -> None:
        """End receiving for another stream; what is being committed is committed."""
        self.gave_way = True
        if self.taking is not None:
            self.taking.cancel()


class Upload:
    """A checked header and its blobs on their way in. Every method blocks."""

    def __init__(
        self, agent: AgentRow, header: submap_pb2.SubmapHeader, digest: bytes, store: Store
    ) -> None:
        self.agent = agent
        self.header = header
        self.partial: PartialUpload
        self._digest = digest
        self._store = store
        self._gaussian_count = 0

    @property
    def complete(self) -> bool:
        """Whether every blob has come."""
        return self.partial.cursor.done

    def open(self) -> None:
        """Take up what is kept of this very upload, or begin."""
        name = UploadName(self.header.name, self.header.request_id)
        kept = self._store.uploads.take(name)
        if kept is not None and kept.header_sha256 != self._digest:
            kept.discard()
            kept = None
        if kept is None:
            self._begin(name)
            return
        self.partial = kept
        try:
            for index in range(kept.cursor.position[0]):
                self._check(index)
        except MagicError:
            logger.warning("%s: what was kept of the upload is damaged; starting over", name.submap)
            kept.discard()
            self._begin(name)

    def put(self, chunk: submap_pb2.BlobChunk, first: bool) -> None:
        """Check, write and hash a chunk; check the blob when it is complete."""
        check_chunk(chunk)
        if first and (chunk.blob_index, chunk.offset) == (0, 0) and self.partial.held_bytes:
            self.partial.discard()
            self._begin(self.partial.name)
        index = self.partial.put(chunk)
        if index is not None:
            self._check(index)

    def new_submap(self) -> NewSubmap:
        """Everything for the transaction."""
        return NewSubmap(
            header=self.header,
            header_sha256=self._digest,
            gaussian_count=self._gaussian_count,
            digests=tuple(blob.sha256.hex() for blob in self.header.blobs),
            vertex=Vertex.of(self.header),
        )

    def _begin(self, name: UploadName) -> None:
        self._gaussian_count = 0
        self.partial = self._store.uploads.begin(name, self.header, self._digest)

    def _check(self, index: int) -> None:
        """Raise unless a complete blob is what the header says."""
        blob = self.partial.blobs[index]
        if blob.sha256 != self.header.blobs[index].sha256.hex():
            raise CorruptData(f"blobs[{index}]: its SHA-256 is not the header's; send it again")
        self._gaussian_count += check_blob(self.header, index, blob.path.read_bytes())


async def _to_the_end(work: asyncio.Future[_T]) -> _T:
    """The result of work that goes on while the caller is cancelled; the caller ends after it.

    Otherwise the next stream of an upload would find its files while they are still moved about.
    """
    cancelled: asyncio.CancelledError | None = None
    while not work.done():
        try:
            await asyncio.wait([work])
        except asyncio.CancelledError as error:
            cancelled = error
    if cancelled is not None:
        if not work.cancelled():
            work.exception()  # whoever was cancelled asks for no result
        raise cancelled
    return work.result()


async def next_message(messages: AsyncIterator[_T], idle_s: float) -> _T | None:
    """The next message of a stream, None at its end; DeadlineExceeded when none comes."""
    try:
        async with asyncio.timeout(idle_s):
            return await anext(messages, None)
    except TimeoutError as error:
        raise DeadlineExceeded(f"no message for {idle_s:g} s; submit again") from error


def _digest(header: submap_pb2.SubmapHeader) -> bytes:
    return hashlib.sha256(header.SerializeToString(deterministic=True)).digest()


def _require_same(name: UploadName, digest: bytes, first: FirstAnswer) -> None:
    _require_same_request(name, first)
    if first.header_sha256 != digest:
        raise AlreadyExists(
            f"{name.submap} is stored already; request {name.request_id!r} had other content"
        )


def _require_same_request(name: UploadName, first: FirstAnswer) -> None:
    if first.request_id != name.request_id:
        raise AlreadyExists(f"{name.submap} is stored already, by another request")


def _repeated(first: FirstAnswer) -> Received:
    return Received(first.received_at, first.stored_bytes, True)
