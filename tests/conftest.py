"""Real servers on a free port, for every test that wants one."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from magic_agent.client import ClientConfig, MagicClient
from magic_server.config import ListenConfig, ServerConfig, ServiceLimits
from magic_server.jobs import JobConfig
from magic_server.server import Server


@pytest.fixture
def server_config(tmp_path: Path) -> ServerConfig:
    """A server of its own data folder, on a port that the system chooses."""
    return ServerConfig(
        data_dir=tmp_path / "data",
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        limits=ServiceLimits(io_threads=2),
        jobs=JobConfig(workers=1, niceness=0),
    )


@pytest.fixture
async def server(server_config: ServerConfig) -> AsyncIterator[Server]:
    """A running server."""
    async with Server(server_config) as running:
        yield running


@pytest.fixture
async def client(server: Server) -> AsyncIterator[MagicClient]:
    """A client of the running server."""
    async with MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as connected:
        yield connected
