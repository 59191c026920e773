"""GlobalMapService: merging as operations, and reading maps."""

from __future__ import annotations

from collections.abc import AsyncIterator

import grpc.aio
from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import global_map_service_pb2_grpc as map_grpc
from magicslam.v1 import submap_pb2

from magic_core.errors import InvalidInput, NotFound
from magic_core.wire import convert, names, records
from magic_server.globalmaps import GlobalMaps
from magic_server.preview import PREVIEW_ID, Previews
from magic_server.servicers.downloads import file_chunks
from magic_server.servicers.fields import check_request_id, page_limit, page_start, token_of
from magic_server.store import Store

Context = grpc.aio.ServicerContext
MAX_WAIT_S = 60.0
DEFAULT_WAIT_S = 10.0


class GlobalMapServicer(map_grpc.GlobalMapServiceServicer):
    """Builds and serves global maps."""

    def __init__(self, store: Store, maps: GlobalMaps, previews: Previews) -> None:
        self._store = store
        self._maps = maps
        self._previews = previews

    async def BuildGlobalMap(  # noqa: N802
        self, request: map_pb.BuildGlobalMapRequest, context: Context
    ) -> map_pb.BuildGlobalMapResponse:
        check_request_id(request.request_id)
        status = await self._maps.build(request)
        return map_pb.BuildGlobalMapResponse(operation=convert.operation_to_proto(status))

    async def GetOperation(  # noqa: N802
        self, request: map_pb.GetOperationRequest, context: Context
    ) -> map_pb.GetOperationResponse:
        status = await self._store.maps.operation(*names.parse_operation(request.name))
        return map_pb.GetOperationResponse(operation=convert.operation_to_proto(status))

    async def WaitOperation(  # noqa: N802
        self, request: map_pb.WaitOperationRequest, context: Context
    ) -> map_pb.WaitOperationResponse:
        if not 0.0 <= request.timeout_s <= MAX_WAIT_S:
            raise InvalidInput.field("timeout_s", f"expected 0 to {MAX_WAIT_S:g} seconds")
        if not 0.0 <= request.above_progress <= 1.0:
            raise InvalidInput.field("above_progress", "expected 0 to 1")
        status = await self._maps.wait(
            *names.parse_operation(request.name),
            timeout_s=request.timeout_s or DEFAULT_WAIT_S,
            above_progress=request.above_progress,
        )
        return map_pb.WaitOperationResponse(operation=convert.operation_to_proto(status))

    async def ListOperations(  # noqa: N802
        self, request: map_pb.ListOperationsRequest, context: Context
    ) -> map_pb.ListOperationsResponse:
        session = names.parse_session(request.session, field="session")
        found, following = await self._store.maps.operation_page(
            await self._store.agents.session(session),
            after=page_start(request.page_token),
            limit=page_limit(request.page_size),
        )
        return map_pb.ListOperationsResponse(
            operations=[convert.operation_to_proto(status) for status in found],
            next_page_token=token_of(following),
        )

    async def GetGlobalMap(  # noqa: N802
        self, request: map_pb.GetGlobalMapRequest, context: Context
    ) -> AsyncIterator[map_pb.GetGlobalMapResponse]:
        map_id = None
        if "/maps/" in request.name:
            session, map_id = names.parse_map(request.name)
        else:
            session = names.parse_session(request.name)
        kind = convert.map_format_from_proto(request.format)
        info, sha256, length, chunks = await self._found(session, map_id, kind)
        header = map_pb.GlobalMapHeader(
            map=convert.map_to_proto(info),
            format=convert.map_format_to_proto(kind),
            length=length,
            sha256=bytes.fromhex(sha256),
        )
        yield map_pb.GetGlobalMapResponse(header=header)
        async for chunk in chunks:
            yield map_pb.GetGlobalMapResponse(chunk=chunk)

    async def _found(
        self, session: str, map_id: str | None, kind: records.MapFormat
    ) -> tuple[records.GlobalMapInfo, str, int, AsyncIterator[submap_pb2.BlobChunk]]:
        """A map, its file's SHA-256 and length, and its chunks.

        The preview where it is named, or where no map is and none is merged yet.
        """
        if map_id != PREVIEW_ID:
            try:
                info, file = await self._store.maps.map_file(session, map_id, kind)
            except NotFound:
                if map_id is not None:
                    raise
            else:
                chunks = file_chunks(self._store.blobs, file.sha256, self._store.blob_threads)
                return info, file.sha256, file.length, chunks
        return await self._previews.stream(session, kind)
