"""A server whose blobs are in a bucket, when the bucket goes away and when the server dies."""

from __future__ import annotations

import asyncio
import dataclasses
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import magic_server.blob_watch
from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import CorruptData, NotFound, Unavailable
from magic_core.wire import encode_submap
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.preview_config import PreviewConfig
from magic_server.probes import MetricsConfig
from magic_server.server import Server
from magic_server.store import Store
from magic_server.store_config import StoreConfig
from tests.bucket import SECRET, BucketServer, bucket_server
from tests.server.test_metrics import get, scraped
from tests.server.test_store_durability import new_submap, registered
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually

REPOSITORY = Path(__file__).resolve().parents[2]
NAME = "sessions/room/agents/agent_0/submaps/0"
DIES = """
import asyncio, os, pathlib, signal, sys
from concurrent.futures import ThreadPoolExecutor
from magic_server.store import Store
from magic_server.store_config import StoreConfig
from tests.server.test_store_durability import new_submap, registered
from tests.small_world import make_submap

async def main():
    folder, blobs, endpoint = sys.argv[1:]
    with ThreadPoolExecutor(2) as threads:
        config = StoreConfig(blobs=blobs, s3_endpoint=endpoint)
        async with Store(pathlib.Path(folder), threads, config=config) as store:
            agent = await registered(store)
            async def die(arrivals):
                os.kill(os.getpid(), signal.SIGKILL)
            store.submaps.insert = die
            made, written = new_submap(make_submap(), store)
            await store.add_submap(agent, made, written, now=1.0)
asyncio.run(main())
"""


@pytest.fixture(scope="module")
def s3() -> Iterator[BucketServer]:
    with bucket_server() as running:
        yield running


@pytest.fixture
async def server(
    s3: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Server]:
    """A server that looks at its bucket all the time and starts no workers."""
    monkeypatch.setattr(magic_server.blob_watch, "LOOK_S", 0.1)
    config = ServerConfig(
        data_dir=tmp_path / "data",
        store=s3.store(s3_timeout_s=60.0),
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        jobs=JobConfig(workers=1),
        loops=LoopConfig(enabled=False),
        preview=PreviewConfig(enabled=False),
        metrics=MetricsConfig(port=0),
    )
    async with Server(config) as running:
        yield running


@pytest.fixture
async def client(server: Server) -> AsyncIterator[MagicClient]:
    async with MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as connected:
        await connected.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        yield connected


async def until_ready(server: Server, expected: bool) -> str:
    """What /readyz says once it says so."""
    found: list[tuple[int, str]] = [(0, "")]

    async def poll() -> None:
        while found[0][0] != (200 if expected else 503):
            found[0] = await get(server, "/readyz")

    await asyncio.wait_for(poll(), 60.0)
    return found[0][1]


async def test_nothing_is_acknowledged_while_the_bucket_is_away_and_clients_repeat_it(
    s3: BucketServer, server: Server, client: MagicClient
) -> None:
    submap = encode_submap(make_submap(), request_id="r")
    once = ClientConfig(attempts=1, rpc_timeout_s=60.0)
    with s3.away():
        assert "is away" in await until_ready(server, False)
        async with MagicClient(server.address, once) as impatient:
            with pytest.raises(Unavailable, match=r"the bucket .* is away"):
                await impatient.submit_encoded(submap)
        assert await client.list_submaps("room") == ()
        sending = asyncio.create_task(client.submit_encoded(submap))
        await eventually(lambda: server.metrics.registry.get_sample_value(
            "magic_blob_requests_total", {"operation": "put", "outcome": "failed"}))  # fmt: skip
        assert not sending.done()
    receipt = await sending
    assert receipt.stored_bytes == sum(map(len, submap.blobs))
    assert (await client.download_encoded(NAME)).blobs == submap.blobs
    assert await until_ready(server, True) == "ready\n"
    samples = await scraped(server)
    assert samples["magic_blob_requests_total{operation=put,outcome=ok}"] >= len(submap.blobs)
    assert samples["magic_ready"] == 1.0


async def test_a_damaged_blob_is_named_when_it_is_downloaded(
    s3: BucketServer, server: Server, client: MagicClient
) -> None:
    submap = encode_submap(make_submap(), request_id="r")
    await client.submit_encoded(submap)
    digest = submap.header.blobs[0].sha256.hex()
    path = f"{server.config.store.blobs.removeprefix('s3://')}/blobs/{digest[0]}/{digest}"
    data = bytearray(s3.files().cat_file(path))
    data[100] ^= 1
    s3.files().pipe_file(path, bytes(data))
    with pytest.raises(CorruptData, match=f"{digest} is damaged") as error:
        await client.download_encoded(NAME)
    assert SECRET not in error.value.message
    with pytest.raises(CorruptData, match=f"{digest} is damaged"):
        await collected(client.export_session("room"))
    s3.files().rm_file(path)
    with pytest.raises(NotFound):
        await collected(client.export_session("room"))


async def collected(pieces: AsyncIterator[bytes]) -> list[bytes]:
    return [piece async for piece in pieces]


async def test_a_session_goes_from_a_bucket_into_files_and_back(
    s3: BucketServer, server: Server, client: MagicClient, tmp_path: Path
) -> None:
    submap = encode_submap(make_submap(), request_id="r")
    await client.submit_encoded(submap)
    await client.finish_agent("room", "agent_0")
    archive = [piece async for piece in client.export_session("room")]

    async def pieces(data: list[bytes]) -> AsyncIterator[bytes]:
        for piece in data:
            yield piece

    files = dataclasses.replace(
        server.config, data_dir=tmp_path / "files", store=StoreConfig(), metrics=MetricsConfig()
    )
    async with Server(files) as other, MagicClient(other.address) as second:
        await second.import_session(pieces(archive), request_id="there")
        assert (await second.download_encoded(NAME)).blobs == submap.blobs
        back = [piece async for piece in second.export_session("room")]
    await client.delete_session("room", force=True)
    assert list(server._store.blobs.names()) == []
    kept = sorted(server.config.data_dir.rglob("*"))
    await client.import_session(pieces(back), request_id="back")
    assert sorted(server.config.data_dir.rglob("*")) == kept  # nothing went over the disk
    assert (await client.download_encoded(NAME)).blobs == submap.blobs


async def test_a_server_killed_between_its_blobs_and_its_commit_has_stored_nothing(
    s3: BucketServer, tmp_path: Path
) -> None:
    config = s3.store()
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", DIES, str(tmp_path), config.blobs, config.s3_endpoint, cwd=REPOSITORY
    )
    assert await process.wait() == -signal.SIGKILL
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads, config=config) as store:
            made, written = new_submap(make_submap(), store)
            agent = await registered(store)
            assert set(store.blobs.names()) == set(made.digests)  # they were there
            assert await store.submaps.first_answer(agent, 0) is None
            assert await store.collect_orphans() == len(set(made.digests))
            assert await store.add_submap(agent, made, written, now=2.0) is None
            assert set(store.blobs.names()) == set(made.digests)
