"""Arrays to messages and back: sub-maps, chunks, checksums, errors, transport settings."""

from magic_core.wire.channel import Transport, client_options, server_options
from magic_core.wire.chunks import MAX_CHUNK_BYTES, ChunkCursor, check_chunk, chunks_of
from magic_core.wire.credentials import AnnotatedChannel, ClientCredentials, open_channel
from magic_core.wire.errors import error_of, grpc_status_of, status_of
from magic_core.wire.header_check import SubmapLimits, check_header
from magic_core.wire.submap import (
    EncodedSubmap,
    SubmapEncoding,
    check_blob,
    decode_submap,
    encode_submap,
)

__all__ = [
    "MAX_CHUNK_BYTES",
    "AnnotatedChannel",
    "ChunkCursor",
    "ClientCredentials",
    "EncodedSubmap",
    "SubmapEncoding",
    "SubmapLimits",
    "Transport",
    "check_blob",
    "check_chunk",
    "check_header",
    "chunks_of",
    "client_options",
    "decode_submap",
    "encode_submap",
    "error_of",
    "grpc_status_of",
    "open_channel",
    "server_options",
    "status_of",
]
