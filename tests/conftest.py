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
from tests.bucket import BucketServer
from tests.bucket import bucket_server as running_bucket_server
from tests.cluster import Cluster, running_cluster
from tests.postgresql import NewStore, NoPostgres, PostgresServer, postgres_server

ENGINES = (
    "sqlite",
    pytest.param("postgresql", marks=pytest.mark.slow),
    pytest.param("cluster", marks=pytest.mark.slow),
)
"""SQLite, files and processes; PostgreSQL with pgvector; and that with S3 and Dask beside it."""


@pytest.fixture(scope="session")
def postgresql() -> Iterator[PostgresServer]:
    """A PostgreSQL server for all tests that want one."""
    try:
        with postgres_server() as running:
            yield running
    except NoPostgres as error:
        pytest.skip(f"PostgreSQL cannot be started: {error}")


@pytest.fixture(scope="session")
def bucket_server() -> Iterator[BucketServer]:
    """An S3 server for all tests that want one."""
    with running_bucket_server() as running:
        yield running


@pytest.fixture(scope="session")
def cluster(bucket_server: BucketServer, tmp_path_factory: pytest.TempPathFactory):
    """A Dask cluster whose one worker reaches the S3 server and shares no folder with anybody."""
    with running_cluster(tmp_path_factory.mktemp("cluster")) as running:
        running.start_worker("worker", "--processes", "2")
        yield running


@pytest.fixture(scope="module", params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    """Each set of engines in turn."""
    return request.param


@pytest.fixture(scope="module")
def new_store(engine: str, request: pytest.FixtureRequest) -> NewStore:
    """Makes settings of an empty database and an empty place for blobs."""
    if engine == "sqlite":
        return StoreConfig
    server: PostgresServer = request.getfixturevalue("postgresql")
    index = "pgvector" if server.has_pgvector else "faiss"
    if engine == "postgresql":
        return lambda: StoreConfig(database=server.database(), index=index)
    bucket: BucketServer = request.getfixturevalue("bucket_server")
    return lambda: bucket.store(database=server.database(), index=index)


@pytest.fixture(scope="module")
def jobs(engine: str, request: pytest.FixtureRequest) -> JobConfig:
    """Where heavy work runs."""
    if engine != "cluster":
        return JobConfig(workers=1, niceness=0)
    running: Cluster = request.getfixturevalue("cluster")
    return JobConfig(executor="dask", scheduler=running.address, connect_timeout_s=60.0)


@pytest.fixture
def server_config(tmp_path: Path, new_store: NewStore, jobs: JobConfig) -> ServerConfig:
    """A server of its own data folder, on a port that the system chooses."""
    return ServerConfig(
        data_dir=tmp_path / "data",
        store=new_store(),
        cluster=ClusterConfig(replica="one"),
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        limits=ServiceLimits(io_threads=2),
        jobs=jobs,
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
