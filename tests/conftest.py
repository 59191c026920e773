"""Real servers on a free port, for every test that wants one."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from magic_agent.client import ClientConfig, MagicClient
from magic_server.cluster_config import ClusterConfig
from magic_server.config import ListenConfig, ServerConfig, ServiceLimits
from magic_server.jobs import JobConfig
from magic_server.server import Server
from magic_server.store_config import StoreConfig
from tests.postgresql import NewStore, NoPostgres, PostgresServer, postgres_server

ENGINES = ("sqlite", pytest.param("postgresql", marks=pytest.mark.slow))


@pytest.fixture(scope="session")
def postgresql() -> Iterator[PostgresServer]:
    """A PostgreSQL server for all tests that want one."""
    try:
        with postgres_server() as running:
            yield running
    except NoPostgres as error:
        pytest.skip(f"PostgreSQL cannot be started: {error}")


@pytest.fixture(scope="module", params=ENGINES)
def new_store(request: pytest.FixtureRequest) -> NewStore:
    """Makes settings of an empty database, on each engine in turn."""
    if request.param == "sqlite":
        return StoreConfig
    server: PostgresServer = request.getfixturevalue("postgresql")
    index = "pgvector" if server.has_pgvector else "faiss"
    return lambda: StoreConfig(database=server.database(), index=index)


@pytest.fixture
def server_config(tmp_path: Path, new_store: NewStore) -> ServerConfig:
    """A server of its own data folder, on a port that the system chooses."""
    return ServerConfig(
        data_dir=tmp_path / "data",
        store=new_store(),
        cluster=ClusterConfig(replica="one"),
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
