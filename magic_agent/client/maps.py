"""Calls of GlobalMapService: merging as operations, and reading maps."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable

from magicslam.v1 import global_map_service_pb2 as map_pb

from magic_agent.client.connection import Connection, new_id
from magic_core.errors import (
    CorruptData,
    DeadlineExceeded,
    InvalidInput,
    MagicError,
    NotSupported,
)
from magic_core.gaussians import GaussianCloud, codec
from magic_core.gaussians.region import Region
from magic_core.wire import check_chunk, convert, names, records
from magic_core.wire.chunks import sha256
from magic_core.wire.errors import error_class


class MapCalls(Connection):
    """Builds and reads global maps."""

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
            request_id=request_id or new_id(),
            component=component or "",
            coarse_only=coarse_only,
            drain_timeout_s=drain_timeout_s,
        )
        answer = await self.idempotent(self.map_stub.BuildGlobalMap, request)
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
        answer = await self.idempotent(
            self.map_stub.GetOperation, map_pb.GetOperationRequest(name=name)
        )
        return convert.operation_from_proto(answer.operation)

    async def list_operations(self, session: str) -> tuple[records.OperationStatus, ...]:
        """The operations of a session, oldest first."""
        request = map_pb.ListOperationsRequest(session=names.session_name(session))
        pages = self.pages(self.map_stub.ListOperations, request)
        return tuple([convert.operation_from_proto(o) async for p in pages for o in p.operations])

    async def get_global_map(
        self, name: str, *, region: Region | None = None, max_gaussians: int = 0
    ) -> GaussianCloud:
        """The Gaussians of a map, float32 bit for bit, in its component's world frame.

        `name` is a map's resource name, `sessions/{s}` for the session's newest, or
        `sessions/{s}/maps/preview` for the preview that follows the pose graph. `region` and
        `max_gaussians` as in `download_global_map`.
        """
        _, data = await self.download_global_map(
            name, format="lossless", region=region, max_gaussians=max_gaussians
        )
        return await asyncio.to_thread(codec.decode, data)

    async def download_global_map(
        self,
        name: str,
        *,
        format: records.MapFormat = "ply",
        region: Region | None = None,
        max_gaussians: int = 0,
    ) -> tuple[records.GlobalMapInfo, bytes]:
        """A map's description, with what was sent of it in `part`, and the bytes of its file.

        Only the Gaussians whose means lie in `region`, a box of the map's world frame, if one is
        given. Where these are more than `max_gaussians` (0: no bound), neighbours that are alike
        are merged until so many are left. NotSupported where the server knows whole maps only.
        """
        if not 0 <= max_gaussians < 1 << 64:
            raise InvalidInput.field("max_gaussians", f"{max_gaussians}: expected 0 or more")
        request = map_pb.GetGlobalMapRequest(
            name=name,
            format=convert.map_format_to_proto(format),
            region=None if region is None else convert.region_to_proto(region),
            max_gaussians=max_gaussians,
        )

        async def attempt() -> tuple[map_pb.GlobalMapHeader, bytes]:
            timeout = self.config.download_timeout_s
            header, pieces = None, []
            async for message in self.map_stub.GetGlobalMap(request, timeout=timeout):
                if message.WhichOneof("payload") == "header":
                    header = message.header
                    _part_of(header, request)
                else:
                    check_chunk(message.chunk)
                    pieces.append(message.chunk.data)
            if header is None:
                raise CorruptData(f"the download of {name} has no header")
            return header, b"".join(pieces)

        header, data = await self.retried(attempt)
        if await asyncio.to_thread(sha256, data) != header.sha256:
            raise CorruptData(f"{name}: {len(data)} bytes received, their SHA-256 does not match")
        info = convert.map_from_proto(header.map)
        return dataclasses.replace(info, part=_part_of(header, request)), data

    async def _wait_step(self, operation: records.OperationStatus) -> records.OperationStatus:
        wait_s = min(10.0, self.config.rpc_timeout_s / 2)
        request = map_pb.WaitOperationRequest(
            name=operation.name, timeout_s=wait_s, above_progress=operation.progress
        )
        try:
            answer = await self.idempotent(self.map_stub.WaitOperation, request)
        except DeadlineExceeded:
            return operation  # a busy server answers late: how long to wait is the caller's say
        return convert.operation_from_proto(answer.operation)


def _part_of(
    header: map_pb.GlobalMapHeader, request: map_pb.GetGlobalMapRequest
) -> records.MapPart:
    """What is sent of a map; NotSupported where that is not what was asked for."""
    if header.HasField("part"):
        return convert.part_from_proto(header.part)
    count = header.map.gaussian_count
    if request.HasField("region") or 0 < request.max_gaussians < count:
        raise NotSupported(
            "this server sends whole maps only, no regions and levels of detail; update it, or "
            "ask for the whole map"
        )
    return records.MapPart(None, request.max_gaussians, count, count)


def _error_of_operation(status: records.OperationStatus) -> MagicError:
    """The error a failed operation ended with, of the class that the server raised."""
    if status.error is None:
        return MagicError(f"{status.name} ended without a result")
    kind = error_class(status.error.reason, status.error.code)
    return kind(status.error.message)
