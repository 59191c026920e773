"""SessionService: reading, listing and deleting what is stored."""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor
from typing import Any

import grpc.aio
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc
from magicslam.v1 import submap_pb2

from magic_core.errors import InvalidInput, NotFound
from magic_core.wire import check_chunk, convert, names
from magic_server.archive import Archives
from magic_server.config import ServiceLimits
from magic_server.receiving import next_message
from magic_server.removal import Removal
from magic_server.servicers.downloads import file_chunks
from magic_server.servicers.fields import check_request_id, page_limit, page_start, token_of
from magic_server.sessions import Sessions
from magic_server.store import Store

Context = grpc.aio.ServicerContext


class SessionServicer(session_grpc.SessionServiceServicer):
    """Sessions, their agents and their sub-maps."""

    def __init__(
        self,
        store: Store,
        sessions: Sessions,
        *,
        removal: Removal,
        threads: Executor,
        limits: ServiceLimits,
    ) -> None:
        self._store = store
        self._sessions = sessions
        self._removal = removal
        self._threads = threads
        self._limits = limits
        self._archives = Archives(store, threads=store.blob_threads, limits=limits.submap)

    async def GetSession(  # noqa: N802
        self, request: session_pb.GetSessionRequest, context: Context
    ) -> session_pb.GetSessionResponse:
        session = await self._session(names.parse_session(request.name))
        return session_pb.GetSessionResponse(session=session)

    async def ListSessions(  # noqa: N802
        self, request: session_pb.ListSessionsRequest, context: Context
    ) -> session_pb.ListSessionsResponse:
        found, following = await self._store.agents.session_page(
            after=page_start(request.page_token), limit=page_limit(request.page_size)
        )
        return session_pb.ListSessionsResponse(
            sessions=[convert.session_to_proto(info) for info in found],
            next_page_token=token_of(following),
        )

    async def DeleteSession(  # noqa: N802
        self, request: session_pb.DeleteSessionRequest, context: Context
    ) -> session_pb.DeleteSessionResponse:
        check_request_id(request.request_id)
        deleted = await self._removal.session(
            request.name, request_id=request.request_id, force=request.force
        )
        return session_pb.DeleteSessionResponse(
            submap_count=deleted.submap_count, freed_bytes=deleted.freed_bytes
        )

    async def GetAgent(  # noqa: N802
        self, request: session_pb.GetAgentRequest, context: Context
    ) -> session_pb.GetAgentResponse:
        session, agent = names.parse_agent(request.name)
        row = await self._store.agents.session(session)
        found, _ = await self._store.agents.agent_page(row, agent=agent)
        if not found:
            raise NotFound(f"{request.name} does not exist")
        return session_pb.GetAgentResponse(agent=convert.agent_to_proto(found[0]))

    async def ListAgents(  # noqa: N802
        self, request: session_pb.ListAgentsRequest, context: Context
    ) -> session_pb.ListAgentsResponse:
        session = names.parse_session(request.session, field="session")
        found, following = await self._store.agents.agent_page(
            await self._store.agents.session(session),
            after=page_start(request.page_token),
            limit=page_limit(request.page_size),
        )
        return session_pb.ListAgentsResponse(
            agents=[convert.agent_to_proto(info) for info in found],
            next_page_token=token_of(following),
        )

    async def DeleteAgent(  # noqa: N802
        self, request: session_pb.DeleteAgentRequest, context: Context
    ) -> session_pb.DeleteAgentResponse:
        check_request_id(request.request_id)
        deleted = await self._removal.agent(
            request.name, request_id=request.request_id, force=request.force
        )
        return session_pb.DeleteAgentResponse(
            submap_count=deleted.submap_count, freed_bytes=deleted.freed_bytes
        )

    async def GetSubmap(  # noqa: N802
        self, request: session_pb.GetSubmapRequest, context: Context
    ) -> session_pb.GetSubmapResponse:
        session, agent, index = names.parse_submap(request.name)
        row = await self._store.agents.session(session)
        stored = await self._store.submaps.stored(row, agent, index)
        info = await self._store.submaps.info(row, agent, index)
        return session_pb.GetSubmapResponse(
            submap=convert.submap_info_to_proto(info),
            header=submap_pb2.SubmapHeader.FromString(stored.header),
        )

    async def ListSubmaps(  # noqa: N802
        self, request: session_pb.ListSubmapsRequest, context: Context
    ) -> session_pb.ListSubmapsResponse:
        agent = None
        if "/agents/" in request.parent:
            session, agent = names.parse_agent(request.parent, field="parent")
            await self._store.agents.agent(session, agent)
        else:
            session = names.parse_session(request.parent, field="parent")
        found, following = await self._store.submaps.page(
            await self._store.agents.session(session),
            agent=agent,
            after=page_start(request.page_token),
            limit=page_limit(request.page_size),
        )
        return session_pb.ListSubmapsResponse(
            submaps=[convert.submap_info_to_proto(info) for info in found],
            next_page_token=token_of(following),
        )

    async def DeleteSubmap(  # noqa: N802
        self, request: session_pb.DeleteSubmapRequest, context: Context
    ) -> session_pb.DeleteSubmapResponse:
        check_request_id(request.request_id)
        deleted = await self._removal.submap(
            request.name, request_id=request.request_id, force=request.force
        )
        return session_pb.DeleteSubmapResponse(
            submap_count=deleted.submap_count, freed_bytes=deleted.freed_bytes
        )

    async def DownloadSubmap(  # noqa: N802
        self, request: session_pb.DownloadSubmapRequest, context: Context
    ) -> AsyncIterator[session_pb.DownloadSubmapResponse]:
        session, agent, index = names.parse_submap(request.name)
        row = await self._store.agents.session(session)
        stored = await self._store.submaps.stored(row, agent, index)
        loop = asyncio.get_running_loop()
        parse = submap_pb2.SubmapHeader.FromString
        header = await loop.run_in_executor(self._threads, parse, stored.header)
        yield session_pb.DownloadSubmapResponse(header=header)
        for position, blob in enumerate(header.blobs):
            async for chunk in file_chunks(
                self._store.blobs, blob.sha256.hex(), self._store.blob_threads, blob_index=position
            ):
                yield session_pb.DownloadSubmapResponse(chunk=chunk)

    async def ExportSession(  # noqa: N802
        self, request: session_pb.ExportSessionRequest, context: Context
    ) -> AsyncIterator[session_pb.ExportSessionResponse]:
        offset = 0
        async for data in self._archives.export(names.parse_session(request.name)):
            if data:
                crc32 = await self._in_thread(zlib.crc32, data)
                chunk = submap_pb2.BlobChunk(offset=offset, data=data, crc32=crc32)
                yield session_pb.ExportSessionResponse(chunk=chunk)
                offset += len(data)

    async def ImportSession(  # noqa: N802
        self,
        request_iterator: AsyncIterator[session_pb.ImportSessionRequest],
        context: Context,
    ) -> session_pb.ImportSessionResponse:
        messages = aiter(request_iterator)
        first = await next_message(messages, self._limits.upload_idle_s)
        request_id = "" if first is None else first.request_id
        check_request_id(request_id)
        session = await self._archives.import_(
            self._pieces(first, messages),
            request_id=request_id,
            on_stored=self._sessions.named,  # what its loops still wait for begins
        )
        return session_pb.ImportSessionResponse(session=convert.session_to_proto(session))

    async def _pieces(
        self,
        message: session_pb.ImportSessionRequest | None,
        messages: AsyncIterator[session_pb.ImportSessionRequest],
    ) -> AsyncIterator[bytes]:
        """The bytes of an archive, in order, each piece as it was sent; `message` is the first."""
        request_id = "" if message is None else message.request_id
        offset = 0
        while message is not None:
            if message.request_id not in ("", request_id):
                raise InvalidInput.field("request_id", "not that of the stream's first message")
            await self._in_thread(check_chunk, message.chunk)
            if (message.chunk.blob_index, message.chunk.offset) != (0, offset):
                raise InvalidInput.field(
                    "chunk.offset", f"{message.chunk.offset}, expected {offset} of blob 0"
                )
            offset += len(message.chunk.data)
            yield message.chunk.data
            message = await next_message(messages, self._limits.upload_idle_s)

    async def _session(self, session: str) -> session_pb.Session:
        found, _ = await self._store.agents.session_page(session=session)
        if not found:
            raise NotFound(f"{names.session_name(session)} does not exist")
        return convert.session_to_proto(found[0])

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)
