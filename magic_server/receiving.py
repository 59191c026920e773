"""Taking in one sub-map: every rule checked, every byte hashed, nothing kept of what is refused."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import submap_pb2

from magic_core.errors import AlreadyExists, CorruptData, DeadlineExceeded, InvalidInput, WrongState
from magic_core.wire import ChunkCursor, check_blob, check_chunk, check_header, geometry, names
from magic_core.wire.submap import decode_odometry
from magic_server.config import ServiceLimits
from magic_server.store import (
    AgentRow,
    BlobWriter,
    FirstAnswer,
    NewSubmap,
    Store,
    Vertex,
    require_model,
)
from magic_server.tasks import TaskScope

Messages = AsyncIterator[mapping_pb.SubmitSubmapRequest]


@dataclass(frozen=True, slots=True)
class Received:
    """The answer to an upload."""

    received_at: float
    stored_bytes: int
    duplicate: bool


class SubmapReceiver:
    """Takes uploads, a bounded number at a time."""

    def __init__(self, store: Store, *, threads: Executor, limits: ServiceLimits) -> None:
        self._store = store
        self._threads = threads
        self._limits = limits
        self._places = asyncio.Semaphore(limits.concurrent_uploads)
        self._commits = TaskScope("commits")

    async def close(self) -> None:
        """Wait for commits under way, whose callers may be gone already."""
        await self._commits.finish()

    async def receive(
        self, messages: Messages, *, on_stored: Callable[[AgentRow, Vertex], None]
    ) -> tuple[str, Received]:
        """Take one upload; `on_stored` is called in the order in which sub-maps became durable."""
        async with self._places:
            header = await self._header(messages)
            upload = await self._admitted(header)
            if isinstance(upload, FirstAnswer):
                return header.name, _repeated(upload)
            try:
                await upload.take(messages)
                # A client that goes away must not interrupt the transaction.
                commit = self._commits.start(self._commit(upload, on_stored), name=header.name)
                return header.name, await asyncio.shield(commit)
            finally:
                await asyncio.shield(self._in_thread(upload.discard))

    async def _header(self, messages: Messages) -> submap_pb2.SubmapHeader:
        first = await next_message(messages, self._limits.upload_idle_s)
        if first is None or first.WhichOneof("payload") != "header":
            raise InvalidInput.field("header", "the first message of an upload carries the header")
        await self._in_thread(check_header, first.header, self._limits.submap)
        return first.header

    async def _admitted(self, header: submap_pb2.SubmapHeader) -> Upload | FirstAnswer:
        """The upload, or the first answer when the sub-map is stored already."""
        session, agent_id, index = names.parse_submap(header.name)
        agent = await self._store.agents.agent(session, agent_id)
        digest = await self._in_thread(_digest, header)
        first = await self._store.submaps.first_answer(agent, index)
        if first is not None:
            _require_same(header, digest, first)
            return first
        if agent.finished:
            raise WrongState(f"{names.agent_name(session, agent_id)} has finished")
        vector = header.descriptor.vector
        require_model(agent.session, header.descriptor.model_id, len(vector))
        if header.HasField("odometry"):
            previous = header.odometry.previous_index
            if await self._store.submaps.first_answer(agent, previous) is None:
                name = names.submap_name(session, agent_id, previous)
                raise WrongState(f"odometry refers to {name}, which is not stored; submit it first")
        return Upload(agent, header, digest, store=self._store, receiver=self)

    async def _commit(
        self, upload: Upload, on_stored: Callable[[AgentRow, Vertex], None]
    ) -> Received:
        now = time.time()
        submap = await self._in_thread(upload.new_submap)
        first = await self._store.add_submap(upload.agent, submap, upload.written, now=now)
        if first is not None:
            _require_same(upload.header, upload.digest, first)
            return _repeated(first)
        # No await in between: sub-maps are told of in the order of their transactions.
        on_stored(upload.agent, submap.vertex)
        return Received(now, sum(blob.length for blob in upload.header.blobs), False)

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)

    async def _message(self, messages: Messages) -> mapping_pb.SubmitSubmapRequest | None:
        return await next_message(messages, self._limits.upload_idle_s)


class Upload:
    """The blobs of one sub-map on their way in."""

    def __init__(
        self,
        agent: AgentRow,
        header: submap_pb2.SubmapHeader,
        digest: bytes,
        *,
        store: Store,
        receiver: SubmapReceiver,
    ) -> None:
        self.agent = agent
        self.header = header
        self.digest = digest
        self.written: list[BlobWriter] = []
        self._gaussian_count = 0
        self._store = store
        self._receiver = receiver

    async def take(self, messages: Messages) -> None:
        """Receive every chunk; raises unless all blobs are complete and right."""
        cursor = ChunkCursor(tuple(blob.length for blob in self.header.blobs))
        while not cursor.done:
            message = await self._receiver._message(messages)
            if message is None:
                blob, offset = cursor.position
                raise InvalidInput.field(
                    "chunk", f"the upload ended early, at byte {offset} of blob {blob}"
                )
            if message.WhichOneof("payload") != "chunk":
                raise InvalidInput.field("chunk", "expected a chunk after the header")
            await self._receiver._in_thread(self._put, cursor, message.chunk)
        if await self._receiver._message(messages) is not None:
            raise InvalidInput.field("chunk", "every blob is complete already")

    def new_submap(self) -> NewSubmap:
        """Everything for the transaction."""
        session, agent, index = names.parse_submap(self.header.name)
        prior = None
        if self.header.HasField("world_from_anchor_prior"):
            prior = geometry.pose_from_proto(self.header.world_from_anchor_prior)
        vertex = Vertex(
            name=self.header.name,
            agent=names.agent_name(session, agent),
            index=index,
            descriptor=geometry.descriptor_from_proto(self.header.descriptor),
            odometry=decode_odometry(self.header),
            prior=prior,
            searched=False,
        )
        return NewSubmap(
            header=self.header,
            header_sha256=self.digest,
            gaussian_count=self._gaussian_count,
            digests=tuple(blob.sha256.hex() for blob in self.header.blobs),
            vertex=vertex,
        )

    def discard(self) -> None:
        """Remove what was not adopted by the store."""
        for blob in self.written:
            blob.discard()

    def _put(self, cursor: ChunkCursor, chunk: submap_pb2.BlobChunk) -> None:
        """Check, write and hash a chunk; check the blob when it is complete."""
        check_chunk(chunk)
        index, offset = cursor.position
        complete = cursor.advance(chunk)
        if offset == 0:
            self.written.append(self._store.blobs.writer())
        self.written[index].write(chunk.data)
        if complete:
            self._complete(index)

    def _complete(self, index: int) -> None:
        blob = self.written[index]
        if blob.sha256 != self.header.blobs[index].sha256.hex():
            raise CorruptData(f"blobs[{index}]: its SHA-256 is not the header's; send it again")
        blob.finish()
        self._gaussian_count += check_blob(self.header, index, blob.path.read_bytes())


async def next_message(messages: Messages, idle_s: float) -> mapping_pb.SubmitSubmapRequest | None:
    """The next message of a stream, None at its end; DeadlineExceeded when none comes."""
    try:
        async with asyncio.timeout(idle_s):
            return await anext(messages, None)
    except TimeoutError as error:
        raise DeadlineExceeded(f"no message for {idle_s:g} s; submit again") from error


def _digest(header: submap_pb2.SubmapHeader) -> bytes:
    return hashlib.sha256(header.SerializeToString(deterministic=True)).digest()


def _require_same(header: submap_pb2.SubmapHeader, digest: bytes, first: FirstAnswer) -> None:
    if first.request_id != header.request_id:
        raise AlreadyExists(f"{header.name} is stored already, by another request")
    if first.header_sha256 != digest:
        raise AlreadyExists(
            f"{header.name} is stored already; request {header.request_id!r} had other content"
        )


def _repeated(first: FirstAnswer) -> Received:
    return Received(first.received_at, first.stored_bytes, True)
