"""Settings of the gRPC transport, one definition for both ends.

The default 4 MiB message limit stays: everything large is chunked. Keepalive pings faster than the
server permits end a connection with GOAWAY too_many_pings, hence one place for both figures.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Transport:
    """Keepalive and message limits of both ends."""

    keepalive_s: float = 30.0
    """Idle time after which an end asks whether the other is still there."""
    keepalive_timeout_s: float = 10.0
    """Time without an answer after which the connection counts as lost."""
    window_bytes: int = 256 << 10
    """Bytes of a stream that may be under way to this end. A stream gets at most this much per
    round trip; a link that takes longer for it than `keepalive_timeout_s` counts as lost."""
    max_message_bytes: int = 4 << 20
    """Largest single message, both ways."""


def client_options(transport: Transport = Transport()) -> list[tuple[str, int]]:
    """Channel arguments of a client; gRPC's own retry, which gives up silently, is off."""
    return [
        *_common(transport),
        ("grpc.enable_retries", 0),
        # A connection of its own: clients of one process would share one, and its troubles.
        ("grpc.use_local_subchannel_pool", 1),
        ("grpc.initial_reconnect_backoff_ms", 200),
        ("grpc.min_reconnect_backoff_ms", 200),
        ("grpc.max_reconnect_backoff_ms", 5000),
    ]


def server_options(transport: Transport = Transport()) -> list[tuple[str, int]]:
    """Channel arguments of a server: it permits twice the client's ping rate."""
    return [
        *_common(transport),
        ("grpc.http2.min_ping_interval_without_data_ms", int(transport.keepalive_s * 500)),
        ("grpc.http2.min_recv_ping_interval_without_data_ms", int(transport.keepalive_s * 500)),
        ("grpc.max_concurrent_streams", 1000),  # of one connection; gRPC's own default is endless
        ("grpc.so_reuseport", 0),
    ]


def _common(transport: Transport) -> list[tuple[str, int]]:
    return [
        ("grpc.max_send_message_length", transport.max_message_bytes),
        ("grpc.max_receive_message_length", transport.max_message_bytes),
        ("grpc.keepalive_time_ms", int(transport.keepalive_s * 1000)),
        ("grpc.keepalive_timeout_ms", int(transport.keepalive_timeout_s * 1000)),
        # gRPC gives any ping a minute, whatever the timeout of keepalive.
        ("grpc.http2.ping_timeout_ms", int(transport.keepalive_timeout_s * 1000)),
        # On a slow link a ping waits behind what is under way: a window that follows the bandwidth
        # would let so much pile up there that a link which works counts as lost.
        ("grpc.http2.bdp_probe", 0),
        ("grpc.http2.lookahead_bytes", transport.window_bytes),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
    ]
