"""A plaintext port that serves `grpc.health.v1` and nothing else, for probes that speak no TLS.

The kubelet's gRPC probes are such: they know no certificates. Whoever reaches the port learns
whether the server lives and takes calls, and can do nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import grpc.aio
from grpc_health.v1 import health_pb2_grpc

from magic_core.errors import ConfigError, Unavailable


@dataclass(frozen=True, slots=True)
class HealthPortConfig:
    """A port of its own for gRPC health checks without TLS. The main port answers them too."""

    port: int | None = None
    """TCP port; 0 lets the system choose one, None opens none."""
    host: str = "127.0.0.1"
    """Address to bind; the kubelet asks the pod's, so 0.0.0.0 there."""

    def __post_init__(self) -> None:
        if self.port is not None and not 0 <= self.port <= 65535:
            raise ConfigError.field("health.port", f"{self.port}: expected 0 to 65535")


class HealthPort:
    """Serves a health servicer in plaintext."""

    def __init__(self, config: HealthPortConfig, servicer: health_pb2_grpc.HealthServicer) -> None:
        self._config = config
        # Without the option two servers would share the port, and a probe ask either.
        self._grpc = grpc.aio.server(maximum_concurrent_rpcs=64, options=[("grpc.so_reuseport", 0)])
        health_pb2_grpc.add_HealthServicer_to_server(servicer, self._grpc)
        self.port = 0

    async def start(self) -> None:
        """Listen. Raises Unavailable where the port is taken."""
        where = f"{self._config.host}:{self._config.port}"
        try:
            self.port = self._grpc.add_insecure_port(where)
        except RuntimeError as error:
            raise Unavailable(
                f"cannot listen on {where} for health checks; choose another health.port"
            ) from error
        await self._grpc.start()

    async def close(self) -> None:
        """Close the port at once."""
        await self._grpc.stop(None)
