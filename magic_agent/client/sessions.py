"""Calls of SessionService: reading, listing and deleting what is stored."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator

import grpc
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import submap_pb2

from magic_agent.client.connection import Connection, new_id
from magic_core.errors import CorruptData
from magic_core.submap import Submap
from magic_core.wire import (
    ChunkCursor,
    EncodedSubmap,
    check_chunk,
    chunks_of,
    convert,
    decode_submap,
    error_of,
    names,
    records,
)
from magic_core.wire.chunks import sha256


class SessionCalls(Connection):
    """Sessions, their agents and their sub-maps."""

    async def get_session(self, session: str) -> records.SessionInfo:
        """A session."""
        request = session_pb.GetSessionRequest(name=names.session_name(session))
        answer = await self.idempotent(self.session_stub.GetSession, request)
        return convert.session_from_proto(answer.session)

    async def list_sessions(self) -> tuple[records.SessionInfo, ...]:
        """Every session, oldest first."""
        pages = self.pages(self.session_stub.ListSessions, session_pb.ListSessionsRequest())
        return tuple([convert.session_from_proto(s) async for p in pages for s in p.sessions])

    async def delete_session(
        self, session: str, *, force: bool = False, request_id: str | None = None
    ) -> records.Deletion:
        """Delete a session with all it holds.

        Raises WrongState while one of its agents has not finished, unless `force` is set.
        """
        request = session_pb.DeleteSessionRequest(
            name=names.session_name(session), request_id=request_id or new_id(), force=force
        )
        answer = await self.idempotent(self.session_stub.DeleteSession, request)
        return records.Deletion(answer.submap_count, answer.freed_bytes)

    async def get_agent(self, session: str, agent: str) -> records.AgentInfo:
        """An agent."""
        request = session_pb.GetAgentRequest(name=names.agent_name(session, agent))
        answer = await self.idempotent(self.session_stub.GetAgent, request)
        return convert.agent_from_proto(answer.agent)

    async def list_agents(self, session: str) -> tuple[records.AgentInfo, ...]:
        """The agents of a session, oldest first."""
        request = session_pb.ListAgentsRequest(session=names.session_name(session))
        pages = self.pages(self.session_stub.ListAgents, request)
        return tuple([convert.agent_from_proto(a) async for p in pages for a in p.agents])

    async def delete_agent(
        self, session: str, agent: str, *, force: bool = False, request_id: str | None = None
    ) -> records.Deletion:
        """Delete an agent with its sub-maps; its name is free again.

        Raises WrongState while the agent has not finished, unless `force` is set.
        """
        request = session_pb.DeleteAgentRequest(
            name=names.agent_name(session, agent), request_id=request_id or new_id(), force=force
        )
        answer = await self.idempotent(self.session_stub.DeleteAgent, request)
        return records.Deletion(answer.submap_count, answer.freed_bytes)

    async def get_submap(self, name: str) -> tuple[records.SubmapInfo, submap_pb2.SubmapHeader]:
        """A sub-map's summary, and its header as submitted."""
        request = session_pb.GetSubmapRequest(name=name)
        answer = await self.idempotent(self.session_stub.GetSubmap, request)
        return convert.submap_info_from_proto(answer.submap), answer.header

    async def list_submaps(
        self, session: str, *, agent: str | None = None
    ) -> tuple[records.SubmapInfo, ...]:
        """The sub-maps of a session, or of one agent, in order of arrival."""
        parent = names.agent_name(session, agent) if agent else names.session_name(session)
        request = session_pb.ListSubmapsRequest(parent=parent)
        pages = self.pages(self.session_stub.ListSubmaps, request)
        return tuple([convert.submap_info_from_proto(s) async for p in pages for s in p.submaps])

    async def delete_submap(
        self, name: str, *, force: bool = False, request_id: str | None = None
    ) -> records.Deletion:
        """Delete a sub-map with its loops and the maps merged from it; the odometry of its
        neighbours is joined.

        Raises WrongState while its agent has not finished, unless `force` is set.
        """
        request = session_pb.DeleteSubmapRequest(
            name=name, request_id=request_id or new_id(), force=force
        )
        answer = await self.idempotent(self.session_stub.DeleteSubmap, request)
        return records.Deletion(answer.submap_count, answer.freed_bytes)

    async def download_submap(self, name: str) -> Submap:
        """A stored sub-map, decoded from the bytes that were submitted."""
        encoded = await self.download_encoded(name)
        return await asyncio.to_thread(decode_submap, encoded.header, encoded.blobs)

    async def download_encoded(self, name: str) -> EncodedSubmap:
        """A stored sub-map as bytes, every blob checked against its digest."""
        request = session_pb.DownloadSubmapRequest(name=name)

        async def attempt() -> EncodedSubmap:
            timeout = self.config.download_timeout_s
            return await _collect(self.session_stub.DownloadSubmap(request, timeout=timeout), name)

        return await self.retried(attempt)

    async def export_session(self, session: str) -> AsyncIterator[bytes]:
        """The archive of a session (docs/wire-format.md), piece by piece.

        Not tried again: a session may change between two attempts.
        """
        request = session_pb.ExportSessionRequest(name=names.session_name(session))
        timeout, offset = self.config.download_timeout_s, 0
        call = self.session_stub.ExportSession(request, timeout=timeout)
        try:
            async for message in call:
                check_chunk(message.chunk)
                if message.chunk.offset != offset:
                    raise CorruptData(f"the archive of {session} has a gap at byte {offset}")
                offset += len(message.chunk.data)
                yield message.chunk.data
        except grpc.RpcError as failure:
            raise error_of(failure) from failure
        finally:
            call.cancel()

    async def import_session(
        self, pieces: AsyncIterable[bytes], *, request_id: str | None = None
    ) -> records.SessionInfo:
        """Store the session of an archive; all of it or nothing.

        While the server cannot be reached it is tried again under one request id, if `pieces` can
        be read from the beginning again; what an iterator gave is gone. Raises AlreadyExists when
        there is a session of its name, CorruptData or InvalidInput for an archive that breaks a
        rule, and whatever reading `pieces` raises.
        """
        request_id = request_id or new_id()

        async def attempt() -> session_pb.ImportSessionResponse:
            archive = _Archive(pieces, request_id)
            timeout = self.config.download_timeout_s
            try:
                return await self.session_stub.ImportSession(archive.messages(), timeout=timeout)
            except asyncio.CancelledError:
                if archive.failure is not None:
                    raise archive.failure from None
                raise

        if isinstance(pieces, AsyncIterator):
            with self.own_errors():
                answer = await attempt()
        else:
            answer = await self.retried(attempt)
        return convert.session_from_proto(answer.session)


class _Archive:
    """An archive on its way to a server."""

    def __init__(self, pieces: AsyncIterable[bytes], request_id: str) -> None:
        self.failure: Exception | None = None
        """Why it could not be read; gRPC only says that the call was cancelled."""
        self._pieces = pieces
        self._request_id = request_id

    async def messages(self) -> AsyncIterator[session_pb.ImportSessionRequest]:
        """The archive in chunks; the first message has the request id."""
        offset = 0
        try:
            async for piece in self._pieces:
                for chunk in chunks_of(piece):
                    length = len(chunk.data)
                    chunk.offset = offset
                    request_id = self._request_id if offset == 0 else ""
                    yield session_pb.ImportSessionRequest(chunk=chunk, request_id=request_id)
                    offset += length
        except Exception as failure:
            self.failure = failure
            raise


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
