"""Sending sub-maps: a stream that breaks goes on where it broke.

gRPC's own retry gives up silently on streams of more than 256 KiB; this one does not.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_agent.client.connection import Connection
from magic_core import tracing
from magic_core.errors import DeadlineExceeded, InvalidInput, MagicError, Unavailable
from magic_core.submap import Submap
from magic_core.wire import (
    MAX_CHUNK_BYTES,
    EncodedSubmap,
    SubmapEncoding,
    chunks_of,
    convert,
    encode_submap,
    records,
)

_BEGINNING = records.UploadPosition(blob_index=0, offset=0, durable_bytes=0, stored=False)


class UploadCalls(Connection):
    """Submits sub-maps."""

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

    async def submit_encoded(
        self, encoded: EncodedSubmap, *, resume: bool = False
    ) -> records.SubmapReceipt:
        """Send a sub-map that is bytes already, for example from a spool.

        While the server cannot be reached it is tried again, `config.attempts` times without
        anything gained; each time the stream begins behind the last byte that the server has on
        its disk. `resume`: begin there at once, because an earlier call or process sent a part.
        """
        with tracing.span("submit sub-map", submap=encoded.header.name, bytes=encoded.wire_bytes):
            return await self._submitted(encoded, resume=resume)

    async def _submitted(self, encoded: EncodedSubmap, *, resume: bool) -> records.SubmapReceipt:
        name, request_id = encoded.header.name, encoded.header.request_id
        held, failures = 0, 0
        start = _BEGINNING
        while True:
            try:
                with self.own_errors():
                    if resume:
                        start = await self._position(name, request_id)
                        failures = 0 if start.durable_bytes > held else failures
                        held = max(held, start.durable_bytes)
                    answer = await self._send(encoded, start)
                break
            except MagicError as failure:
                error = failure
            if _is_misplaced(error, start):  # dropped on the server since it was asked
                resume, start = False, _BEGINNING
                continue
            if isinstance(error, DeadlineExceeded):
                error = Unavailable(error.message)
            await self.pause_or_raise(error, failures)
            failures, resume = failures + 1, True
        return records.SubmapReceipt(
            submap=answer.submap,
            received_at=convert.timestamp_from_proto(answer.received_at),
            stored_bytes=answer.stored_bytes,
            duplicate=answer.duplicate,
            wire_bytes=encoded.wire_bytes,
        )

    async def resume_upload(self, submap: str, request_id: str) -> records.UploadPosition:
        """Where an upload that broke off goes on; a stream of it that is still open ends.

        `submit_encoded` asks this by itself.
        """
        return await self.retried(lambda: self._position(submap, request_id))

    async def _position(self, submap: str, request_id: str) -> records.UploadPosition:
        request = mapping_pb.ResumeUploadRequest(submap=submap, request_id=request_id)
        timeout = self.config.rpc_timeout_s
        answer = await self.mapping_stub.ResumeUpload(request, timeout=timeout)
        return records.UploadPosition(
            blob_index=answer.blob_index,
            offset=answer.offset,
            durable_bytes=answer.durable_bytes,
            stored=answer.stored,
        )

    async def _send(
        self, encoded: EncodedSubmap, start: records.UploadPosition
    ) -> mapping_pb.SubmitSubmapResponse:
        timeout = self.config.submit_timeout_s
        return await self.mapping_stub.SubmitSubmap(_messages(encoded, start), timeout=timeout)


async def _messages(
    encoded: EncodedSubmap, start: records.UploadPosition
) -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
    """The header, and the chunks from a position on."""
    yield mapping_pb.SubmitSubmapRequest(header=encoded.header)
    if start.stored:
        return
    for index in range(start.blob_index, len(encoded.blobs)):
        begin = start.offset if index == start.blob_index else 0
        chunks = chunks_of(
            encoded.blobs[index], blob_index=index, chunk_bytes=MAX_CHUNK_BYTES, begin=begin
        )
        for chunk in chunks:
            yield mapping_pb.SubmitSubmapRequest(chunk=chunk)


def _is_misplaced(error: MagicError, start: records.UploadPosition) -> bool:
    """Whether the server refuses the place where a resumed stream began."""
    resumed = start.blob_index or start.offset
    fields = [violation.field for violation in error.violations]
    return bool(resumed and isinstance(error, InvalidInput) and fields == ["chunk.offset"])
