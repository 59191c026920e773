"""The typed async client of the service.

    async with MagicClient("localhost:50051") as client:
        await client.register_agent("kitchen", "agent_0", model_id="dinov2", dimension=384)
        receipt = await client.submit_submap(submap)
        async for snapshot in client.watch_corrected_poses("kitchen"):
            ...

Every call has a deadline. Only calls that are idempotent are tried again, and only when the server
cannot be reached. Failures raise the classes of `magic_core.errors` that the server raised.
"""

from __future__ import annotations

import asyncio
import random
import uuid
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, TypeVar

import grpc
import grpc.aio
from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import global_map_service_pb2_grpc as map_grpc
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc
from magicslam.v1 import submap_pb2

from magic_core.errors import CorruptData, DeadlineExceeded, MagicError, Unavailable
from magic_core.gaussians import GaussianCloud, codec
from magic_core.geometry import Camera
from magic_core.submap import Descriptor, Submap
from magic_core.wire import (
    MAX_CHUNK_BYTES,
    ChunkCursor,
    EncodedSubmap,
    SubmapEncoding,
    Transport,
    check_chunk,
    chunks_of,
    client_options,
    convert,
    decode_submap,
    encode_submap,
    error_of,
    geometry,
    images,
    names,
    records,
)
from magic_core.wire.chunks import sha256
from magic_core.wire.errors import error_class

__all__ = ["ClientConfig", "MagicClient"]

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class ClientConfig:
    """Deadlines and retries of a client."""

    connect_timeout_s: float = 20.0
    """How long `connect` waits for the server."""
    rpc_timeout_s: float = 20.0
    """Deadline of one ordinary call, seconds."""
    submit_timeout_s: float = 300.0
    """Deadline of one attempt to send a sub-map, seconds."""
    download_timeout_s: float = 600.0
    """Deadline of one download, seconds."""
    attempts: int = 5
    """Times an idempotent call is tried while the server cannot be reached."""
    backoff_s: float = 0.25
    """Wait before the second attempt, seconds; doubles each time, with jitter."""
    max_backoff_s: float = 10.0
    """Longest wait between attempts, seconds."""
    encoding: SubmapEncoding = field(default_factory=SubmapEncoding)
    """How sub-maps become bytes."""
    transport: Transport = field(default_factory=Transport)
    """Keepalive and message limits."""


class MagicClient:
    """One connection to a server; every method is safe to call concurrently."""

    def __init__(self, target: str, config: ClientConfig = ClientConfig()) -> None:
        self.target = target
        self.config = config
        self._channel = grpc.aio.insecure_channel(target, client_options(config.transport))
        self._mapping = mapping_grpc.MappingServiceStub(self._channel)
        self._maps = map_grpc.GlobalMapServiceStub(self._channel)
        self._sessions = session_grpc.SessionServiceStub(self._channel)

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def connect(self) -> None:
        """Wait until the server answers; Unavailable when it does not in time."""
        try:
            async with asyncio.timeout(self.config.connect_timeout_s):
                await self._channel.channel_ready()
        except TimeoutError as error:
            waited = self.config.connect_timeout_s
            raise Unavailable(
                f"no server answers at {self.target} within {waited:g} s; is `magic serve` running?"
            ) from error

    async def close(self) -> None:
        """Close the connection; calls under way are cancelled."""
        await self._channel.close(grace=None)

    # Agents

    async def register_agent(
        self,
        session: str,
        agent: str,
        *,
        model_id: str,
        dimension: int,
        request_id: str | None = None,
    ) -> records.AgentRegistration:
        """Enter a session, or resume in it; the session begins with its first agent.

        Raises DescriptorModelMismatch when the session is pinned to another image encoder,
        WrongState when the agent has finished.
        """
        request = mapping_pb.RegisterAgentRequest(
            agent=names.agent_name(session, agent),
            request_id=request_id or _new_id(),
            descriptor_model_id=model_id,
            descriptor_dimension=dimension,
        )
        answer = await self._idempotent(self._mapping.RegisterAgent, request)
        return records.AgentRegistration(
            agent=answer.agent,
            next_submap_index=answer.next_submap_index,
            resumed=answer.resumed,
            revision=answer.revision,
            max_submap_bytes=answer.max_submap_bytes,
            max_chunk_bytes=answer.max_chunk_bytes,
        )

    async def submit_submap(
        self, submap: Submap, *, lossless: bool = False, request_id: str | None = None
    ) -> records.SubmapReceipt:
        """Send a finished sub-map; returns once it is durable on the server.

        The sub-map is encoded on a thread. `request_id` defaults to the sub-map's name, so that a
        repeat after a crash is recognised.
        """
        encoding = SubmapEncoding.lossless() if lossless else self.config.encoding
        request_id = request_id or submap.name
        encoded = await asyncio.to_thread(
            encode_submap, submap, request_id=request_id, encoding=encoding
        )
        return await self.submit_encoded(encoded)

    async def submit_encoded(self, encoded: EncodedSubmap) -> records.SubmapReceipt:
        """Send a sub-map that is bytes already, for example from a spool."""

        async def attempt() -> mapping_pb.SubmitSubmapResponse:
            call = self._mapping.SubmitSubmap(
                _upload(encoded), timeout=self.config.submit_timeout_s
            )
            return await call

        answer = await self._retried(attempt)
        return records.SubmapReceipt(
            submap=answer.submap,
            received_at=convert.timestamp_from_proto(answer.received_at),
            stored_bytes=answer.stored_bytes,
            duplicate=answer.duplicate,
            wire_bytes=encoded.wire_bytes,
        )

    async def finish_agent(self, session: str, agent: str) -> int:
        """Say that an agent will send no more; returns its number of stored sub-maps."""
        request = mapping_pb.FinishAgentRequest(
            agent=names.agent_name(session, agent), request_id=_new_id()
        )
        return (await self._idempotent(self._mapping.FinishAgent, request)).submap_count

    # Loops and poses

    async def query_loops(
        self,
        query: str | Descriptor,
        *,
        session: str | None = None,
        max_candidates: int = 0,
        min_similarity: float = 0.0,
    ) -> records.LoopAnswer:
        """Where else a place was seen, most similar first.

        `query` is the resource name of a stored sub-map, which gives its recorded candidates with
        their verdicts, or a raw descriptor, which needs `session` and gives the nearest sub-maps.
        """
        request = mapping_pb.QueryLoopsRequest(
            session=names.session_name(session) if session else "",
            max_candidates=max_candidates,
            min_similarity=min_similarity,
        )
        if isinstance(query, str):
            request.submap = query
        else:
            request.descriptor.CopyFrom(geometry.descriptor_to_proto(query))
        answer = await self._idempotent(self._mapping.QueryLoops, request)
        candidates = tuple(convert.loop_from_proto(c) for c in answer.candidates)
        return records.LoopAnswer(candidates, answer.revision)

    async def list_loops(self, session: str) -> records.LoopAnswer:
        """Every loop candidate of a session, oldest first."""
        request = mapping_pb.ListLoopsRequest(session=names.session_name(session))
        found: list[records.LoopCandidate] = []
        revision = 0
        async for page in self._pages(self._mapping.ListLoops, request):
            found.extend(convert.loop_from_proto(c) for c in page.candidates)
            revision = page.revision
        return records.LoopAnswer(tuple(found), revision)

    async def get_corrected_poses(
        self, session: str, *, agent: str | None = None
    ) -> records.PoseSnapshot:
        """The newest corrected anchor poses, of one agent where one is named."""
        request = mapping_pb.GetCorrectedPosesRequest(
            session=names.session_name(session), agent=_agent_or_empty(session, agent)
        )
        answer = await self._idempotent(self._mapping.GetCorrectedPoses, request)
        return convert.snapshot_from_proto(answer.snapshot)

    async def watch_corrected_poses(
        self, session: str, *, agent: str | None = None, after_revision: int = 0
    ) -> AsyncIterator[records.PoseSnapshot]:
        """Every new solution from `after_revision` on, coalesced to the newest.

        A broken stream is opened again behind the last revision seen, for as long as the server
        can be reached within the configured attempts. Ends when the caller stops iterating.
        """
        failures = 0
        while True:
            request = mapping_pb.WatchCorrectedPosesRequest(
                session=names.session_name(session),
                agent=_agent_or_empty(session, agent),
                after_revision=after_revision,
            )
            call = self._mapping.WatchCorrectedPoses(request)
            try:
                async for answer in call:
                    failures = 0
                    after_revision = answer.snapshot.revision
                    yield convert.snapshot_from_proto(answer.snapshot)
            except grpc.RpcError as failure:
                await self._pause_or_raise(error_of(failure), failures)
            finally:
                call.cancel()
            failures += 1

    async def get_trajectory(self, session: str, agent: str) -> tuple[records.TrajectoryPart, ...]:
        """The corrected camera pose of every frame of an agent, one part per sub-map."""
        request = mapping_pb.GetTrajectoryRequest(agent=names.agent_name(session, agent))

        async def attempt() -> list[mapping_pb.GetTrajectoryResponse]:
            call = self._mapping.GetTrajectory(request, timeout=self.config.download_timeout_s)
            return [message async for message in call]

        messages = await self._retried(attempt)
        return tuple(convert.trajectory_part_from_proto(message) for message in messages)

    async def localize(
        self, session: str, *, camera: Camera, colour: Any, depth: Any, descriptor: Descriptor
    ) -> records.Localization:
        """The pose of an RGB-D image in the stored map.

        `colour` (h, w, 3) uint8 RGB, `depth` (h, w) float32 metres. Raises NotSupported on a
        server that does not offer it yet.
        """
        request = mapping_pb.LocalizeRequest(
            session=names.session_name(session),
            camera=geometry.camera_to_proto(camera),
            colour=await asyncio.to_thread(images.encode_colour_jpeg, colour),
            colour_media_type=images.JPEG,
            depth_png=await asyncio.to_thread(images.encode_depth_png, depth),
            metres_per_unit=0.001,
            descriptor=geometry.descriptor_to_proto(descriptor),
        )
        answer = await self._idempotent(self._mapping.Localize, request)
        return convert.localization_from_proto(answer)

    # Global maps

    async def build_global_map(
        self,
        session: str,
        *,
        component: str | None = None,
        coarse_only: bool = False,
        drain_timeout_s: float = 0.0,
        timeout_s: float = 3600.0,
        progress: Callable[[float, str], None] | None = None,
        request_id: str | None = None,
    ) -> records.GlobalMapInfo:
        """Merge the sub-maps of a component (the largest by default) and wait for the map.

        `progress` is called with (share done, stage). Raises the error the merge ended with.
        """
        status = await self.start_global_map(
            session,
            component=component,
            coarse_only=coarse_only,
            drain_timeout_s=drain_timeout_s,
            request_id=request_id,
        )
        status = await self.wait_operation(status, timeout_s=timeout_s, progress=progress)
        if status.result is None:
            raise _error_of_operation(status)
        return status.result

    async def start_global_map(
        self,
        session: str,
        *,
        component: str | None = None,
        coarse_only: bool = False,
        drain_timeout_s: float = 0.0,
        request_id: str | None = None,
    ) -> records.OperationStatus:
        """Start to merge and return at once with the operation to follow."""
        request = map_pb.BuildGlobalMapRequest(
            session=names.session_name(session),
            request_id=request_id or _new_id(),
            component=component or "",
            coarse_only=coarse_only,
            drain_timeout_s=drain_timeout_s,
        )
        answer = await self._idempotent(self._maps.BuildGlobalMap, request)
        return convert.operation_from_proto(answer.operation)

    async def wait_operation(
        self,
        operation: records.OperationStatus,
        *,
        timeout_s: float = 3600.0,
        progress: Callable[[float, str], None] | None = None,
    ) -> records.OperationStatus:
        """Wait until an operation is done; DeadlineExceeded when it is not in time."""
        try:
            async with asyncio.timeout(timeout_s):
                while not operation.done:
                    if progress is not None:
                        progress(operation.progress, operation.stage)
                    operation = await self._wait_step(operation)
        except TimeoutError as error:
            raise DeadlineExceeded(
                f"{operation.name} is at {operation.progress:.0%} after {timeout_s:g} s; it goes on"
            ) from error
        if progress is not None:
            progress(operation.progress, operation.stage)
        return operation

    async def get_operation(self, name: str) -> records.OperationStatus:
        """The state of an operation."""
        answer = await self._idempotent(
            self._maps.GetOperation, map_pb.GetOperationRequest(name=name)
        )
        return convert.operation_from_proto(answer.operation)

    async def list_operations(self, session: str) -> tuple[records.OperationStatus, ...]:
        """The operations of a session, oldest first."""
        request = map_pb.ListOperationsRequest(session=names.session_name(session))
        pages = self._pages(self._maps.ListOperations, request)
        return tuple([convert.operation_from_proto(o) async for p in pages for o in p.operations])

    async def get_global_map(self, name: str) -> GaussianCloud:
        """The Gaussians of a map, float32 bit for bit, in its component's world frame.

        `name` is a map's resource name or `sessions/{s}` for the session's newest.
        """
        _, data = await self.download_global_map(name, format="lossless")
        return await asyncio.to_thread(codec.decode, data)

    async def download_global_map(
        self, name: str, *, format: records.MapFormat = "ply"
    ) -> tuple[records.GlobalMapInfo, bytes]:
        """A map's description and the bytes of its file."""
        request = map_pb.GetGlobalMapRequest(name=name, format=convert.map_format_to_proto(format))

        async def attempt() -> tuple[map_pb.GlobalMapHeader, bytes]:
            timeout = self.config.download_timeout_s
            header, pieces = None, []
            async for message in self._maps.GetGlobalMap(request, timeout=timeout):
                if message.WhichOneof("payload") == "header":
                    header = message.header
                else:
                    check_chunk(message.chunk)
                    pieces.append(message.chunk.data)
            if header is None:
                raise CorruptData(f"the download of {name} has no header")
            return header, b"".join(pieces)

        header, data = await self._retried(attempt)
        if await asyncio.to_thread(sha256, data) != header.sha256:
            raise CorruptData(f"{name}: {len(data)} bytes received, their SHA-256 does not match")
        return convert.map_from_proto(header.map), data

    # Sessions

    async def get_session(self, session: str) -> records.SessionInfo:
        """A session."""
        request = session_pb.GetSessionRequest(name=names.session_name(session))
        answer = await self._idempotent(self._sessions.GetSession, request)
        return convert.session_from_proto(answer.session)

    async def list_sessions(self) -> tuple[records.SessionInfo, ...]:
        """Every session, oldest first."""
        pages = self._pages(self._sessions.ListSessions, session_pb.ListSessionsRequest())
        return tuple([convert.session_from_proto(s) async for p in pages for s in p.sessions])

    async def delete_session(self, session: str) -> None:
        """Delete a session. Raises NotSupported on a server that does not offer it yet."""
        request = session_pb.DeleteSessionRequest(name=names.session_name(session))
        await self._idempotent(self._sessions.DeleteSession, request)

    async def get_agent(self, session: str, agent: str) -> records.AgentInfo:
        """An agent."""
        request = session_pb.GetAgentRequest(name=names.agent_name(session, agent))
        answer = await self._idempotent(self._sessions.GetAgent, request)
        return convert.agent_from_proto(answer.agent)

    async def list_agents(self, session: str) -> tuple[records.AgentInfo, ...]:
        """The agents of a session, oldest first."""
        request = session_pb.ListAgentsRequest(session=names.session_name(session))
        pages = self._pages(self._sessions.ListAgents, request)
        return tuple([convert.agent_from_proto(a) async for p in pages for a in p.agents])

    async def delete_agent(self, session: str, agent: str) -> None:
        """Delete an agent. Raises NotSupported on a server that does not offer it yet."""
        request = session_pb.DeleteAgentRequest(name=names.agent_name(session, agent))
        await self._idempotent(self._sessions.DeleteAgent, request)

    async def get_submap(self, name: str) -> tuple[records.SubmapInfo, submap_pb2.SubmapHeader]:
        """A sub-map's summary, and its header as submitted."""
        request = session_pb.GetSubmapRequest(name=name)
        answer = await self._idempotent(self._sessions.GetSubmap, request)
        return convert.submap_info_from_proto(answer.submap), answer.header

    async def list_submaps(
        self, session: str, *, agent: str | None = None
    ) -> tuple[records.SubmapInfo, ...]:
        """The sub-maps of a session, or of one agent, in order of arrival."""
        parent = names.agent_name(session, agent) if agent else names.session_name(session)
        request = session_pb.ListSubmapsRequest(parent=parent)
        pages = self._pages(self._sessions.ListSubmaps, request)
        return tuple([convert.submap_info_from_proto(s) async for p in pages for s in p.submaps])

    async def delete_submap(self, name: str) -> None:
        """Delete a sub-map. Raises NotSupported on a server that does not offer it yet."""
        request = session_pb.DeleteSubmapRequest(name=name)
        await self._idempotent(self._sessions.DeleteSubmap, request)

    async def download_submap(self, name: str) -> Submap:
        """A stored sub-map, decoded from the bytes that were submitted."""
        encoded = await self.download_encoded(name)
        return await asyncio.to_thread(decode_submap, encoded.header, encoded.blobs)

    async def download_encoded(self, name: str) -> EncodedSubmap:
        """A stored sub-map as bytes, every blob checked against its digest."""
        request = session_pb.DownloadSubmapRequest(name=name)

        async def attempt() -> EncodedSubmap:
            timeout = self.config.download_timeout_s
            return await _collect(self._sessions.DownloadSubmap(request, timeout=timeout), name)

        return await self._retried(attempt)

    # Inside

    async def _wait_step(self, operation: records.OperationStatus) -> records.OperationStatus:
        wait_s = min(10.0, self.config.rpc_timeout_s / 2)
        request = map_pb.WaitOperationRequest(
            name=operation.name, timeout_s=wait_s, above_progress=operation.progress
        )
        answer = await self._idempotent(self._maps.WaitOperation, request)
        return convert.operation_from_proto(answer.operation)

    async def _idempotent(self, method: Callable[..., Awaitable[_T]], request: Any) -> _T:
        async def attempt() -> _T:
            return await method(request, timeout=self.config.rpc_timeout_s)

        return await self._retried(attempt)

    async def _retried(self, attempt: Callable[[], Awaitable[_T]]) -> _T:
        failures = 0
        while True:
            try:
                return await attempt()
            except grpc.RpcError as failure:
                await self._pause_or_raise(error_of(failure), failures)
            failures += 1

    async def _pause_or_raise(self, error: MagicError, failures: int) -> None:
        """Sleep before the next attempt, or raise when trying again is no use."""
        if not isinstance(error, Unavailable) or failures + 1 >= self.config.attempts:
            raise error
        pause = min(self.config.backoff_s * 2**failures, self.config.max_backoff_s)
        await asyncio.sleep(pause * random.uniform(0.5, 1.0))

    async def _pages(self, method: Callable[..., Awaitable[_T]], request: Any) -> AsyncIterator[_T]:
        while True:
            page: Any = await self._idempotent(method, request)
            yield page
            if not page.next_page_token:
                return
            request.page_token = page.next_page_token


async def _upload(encoded: EncodedSubmap) -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
    yield mapping_pb.SubmitSubmapRequest(header=encoded.header)
    for index, blob in enumerate(encoded.blobs):
        for chunk in chunks_of(blob, blob_index=index, chunk_bytes=MAX_CHUNK_BYTES):
            yield mapping_pb.SubmitSubmapRequest(chunk=chunk)


async def _collect(
    call: AsyncIterable[session_pb.DownloadSubmapResponse], name: str
) -> EncodedSubmap:
    """The header and blobs of a download; CorruptData when anything is missing or differs."""
    header: submap_pb2.SubmapHeader | None = None
    cursor = ChunkCursor(())
    blobs: list[bytearray] = []
    async for message in call:
        if message.WhichOneof("payload") == "header":
            header = message.header
            cursor = ChunkCursor(tuple(blob.length for blob in header.blobs))
            blobs = [bytearray() for _ in header.blobs]
        else:
            check_chunk(message.chunk)
            cursor.advance(message.chunk)
            blobs[message.chunk.blob_index] += message.chunk.data
    if header is None or not cursor.done:
        raise CorruptData(f"the download of {name} ended early; fetch it again")
    data = tuple(bytes(blob) for blob in blobs)
    if any(sha256(blob) != info.sha256 for blob, info in zip(data, header.blobs, strict=True)):
        raise CorruptData(f"a blob of {name} does not match its SHA-256")
    return EncodedSubmap(header, data)


def _error_of_operation(status: records.OperationStatus) -> MagicError:
    """The error a failed operation ended with, of the class that the server raised."""
    if status.error is None:
        return MagicError(f"{status.name} ended without a result")
    kind = error_class(status.error.reason, status.error.code)
    return kind(status.error.message)


def _agent_or_empty(session: str, agent: str | None) -> str:
    return names.agent_name(session, agent) if agent else ""


def _new_id() -> str:
    return uuid.uuid4().hex
