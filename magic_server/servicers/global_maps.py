"""GlobalMapService: merging as operations, and reading maps."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass

import grpc.aio
from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import global_map_service_pb2_grpc as map_grpc
from magicslam.v1 import submap_pb2

from magic_core.errors import InvalidInput, NotFound
from magic_core.gaussians.region import Region
from magic_core.wire import convert, names, records
from magic_server.excerpts import ExcerptKey, Excerpts
from magic_server.globalmaps import GlobalMaps
from magic_server.preview import PREVIEW_ID, Previews
from magic_server.servicers.downloads import file_chunks
from magic_server.servicers.fields import check_request_id, page_limit, page_start, token_of
from magic_server.store import MapFile, Store
from magic_server.store.blob_store import StreamedFile

Context = grpc.aio.ServicerContext
_Download = tuple[map_pb.GlobalMapHeader, AsyncIterator[submap_pb2.BlobChunk]]
MAX_WAIT_S = 60.0
DEFAULT_WAIT_S = 10.0


class GlobalMapServicer(map_grpc.GlobalMapServiceServicer):
    """Builds and serves global maps."""

    def __init__(
        self, store: Store, maps: GlobalMaps, previews: Previews, excerpts: Excerpts
    ) -> None:
        self._store = store
        self._maps = maps
        self._previews = previews
        self._excerpts = excerpts

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
        region = convert.region_from_proto(request.region) if request.HasField("region") else None
        part = _Part(region, request.max_gaussians)
        async with self._found(session, map_id, kind, part) as (header, chunks):
            header.format = convert.map_format_to_proto(kind)
            yield map_pb.GetGlobalMapResponse(header=header)
            async for chunk in chunks:
                yield map_pb.GetGlobalMapResponse(chunk=chunk)

    @contextlib.asynccontextmanager
    async def _found(
        self, session: str, map_id: str | None, kind: records.MapFormat, part: _Part
    ) -> AsyncIterator[_Download]:
        """The header, which says no format yet, and the chunks of a map or of a part of it.

        Of the preview where it is named, or where no map is and none is merged yet.
        """
        if map_id != PREVIEW_ID:
            try:
                found = await self._store.maps.map_file(session, map_id, kind)
            except NotFound:
                if map_id is not None:
                    raise
            else:
                async with self._of_stored(session, kind, part, *found) as download:
                    yield download
                return
        async with self._of_preview(session, kind, part) as download:
            yield download

    @contextlib.asynccontextmanager
    async def _of_preview(
        self, session: str, kind: records.MapFormat, part: _Part
    ) -> AsyncIterator[_Download]:
        """The preview, or a part of it."""
        while True:  # it may grow from one step to the next
            async with self._previews.held(session) as (info, source):
                if not part.is_whole(info):
                    row = await self._store.agents.session(session)
                    key = part.key(row.id, source, kind)
                    async with self._excerpt(info, source, key) as download:
                        yield download
                    return
            async with self._previews.stream(session, kind) as (info, sha256, length, chunks):
                if part.is_whole(info):
                    yield part.header(info, sha256=sha256, length=length), chunks
                    return

    @contextlib.asynccontextmanager
    async def _of_stored(
        self,
        session: str,
        kind: records.MapFormat,
        part: _Part,
        info: records.GlobalMapInfo,
        file: MapFile,
    ) -> AsyncIterator[_Download]:
        """A finished map, or a part of it."""
        if part.is_whole(info):
            chunks = file_chunks(self._store.blobs, file.sha256, self._store.blob_threads)
            yield part.header(info, sha256=file.sha256, length=file.length), chunks
            return
        row = await self._store.agents.session(session)
        _, map_id = names.parse_map(info.name)
        _, lossless = await self._store.maps.map_file(session, map_id, "lossless")
        source = self._store.blobs.streamed(lossless.sha256)
        async with self._excerpt(info, source, part.key(row.id, source, kind)) as download:
            yield download

    @contextlib.asynccontextmanager
    async def _excerpt(
        self, info: records.GlobalMapInfo, source: StreamedFile, key: ExcerptKey
    ) -> AsyncIterator[_Download]:
        async with self._excerpts.opened(key, source) as (made, chunks):
            part = records.MapPart(
                key.region, key.max_gaussians, made.gaussian_count, made.full_gaussian_count
            )
            yield _header(info, part, sha256=made.sha256, length=made.length), chunks


@dataclass(frozen=True, slots=True)
class _Part:
    """What is wanted of a map."""

    region: Region | None
    max_gaussians: int

    def is_whole(self, info: records.GlobalMapInfo) -> bool:
        """Whether that is all of a map, as its stored file has it."""
        enough = not self.max_gaussians or self.max_gaussians >= info.gaussian_count
        return self.region is None and enough

    def key(self, session: int, source: StreamedFile, kind: records.MapFormat) -> ExcerptKey:
        return ExcerptKey(session, source.sha256, kind, self.region, self.max_gaussians)

    def header(
        self, info: records.GlobalMapInfo, *, sha256: str, length: int
    ) -> map_pb.GlobalMapHeader:
        """The header of a whole map's file."""
        count = info.gaussian_count
        part = records.MapPart(None, self.max_gaussians, count, count)
        return _header(info, part, sha256=sha256, length=length)


def _header(
    info: records.GlobalMapInfo, part: records.MapPart, *, sha256: str, length: int
) -> map_pb.GlobalMapHeader:
    return map_pb.GlobalMapHeader(
        map=convert.map_to_proto(info),
        length=length,
        sha256=bytes.fromhex(sha256),
        part=convert.part_to_proto(part),
    )
