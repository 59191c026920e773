"""What is too much is refused, says how long to wait, and is taken once there is room."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import gc
import os
import subprocess
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import grpc.aio
import psutil
import pytest
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import (
    ConfigError,
    DiskFull,
    MemoryLow,
    Overloaded,
    QuotaExceeded,
    RateLimited,
    ResourceExhausted,
    Unavailable,
)
from magic_core.wire import encode_submap, grpc_status_of
from magic_server.config import ServerConfig, ServiceLimits
from magic_server.drain import Gate
from magic_server.loops import LoopConfig
from magic_server.quotas import QuotaConfig, Rates
from magic_server.resources import ResourceConfig, Resources, Room, available_memory
from magic_server.server import Server
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_files
from tests.waiting import eventually

NO_RETRY = ClientConfig(attempts=1)


@contextlib.asynccontextmanager
async def serving(config: ServerConfig) -> AsyncIterator[tuple[Server, MagicClient]]:
    """A server and a client that tries once."""
    async with Server(config) as server, MagicClient(server.address, NO_RETRY) as client:
        yield server, client


def with_quotas(config: ServerConfig, **quotas: float | int) -> ServerConfig:
    return dataclasses.replace(config, quotas=QuotaConfig(**quotas))  # type: ignore[arg-type]


async def register(client: MagicClient, agent: int = 0, session: str = "room") -> None:
    await client.register_agent(session, f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION)


# Rates


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    now = [100.0]
    rates = Rates(2.0, lambda: now[0])
    assert [rates.spend("a", 1.0, 5.0) for _ in range(10)] == [0.0] * 10
    assert rates.spend("a", 1.0, 5.0) == pytest.approx(0.2)
    now[0] += 0.2
    assert rates.spend("a", 1.0, 5.0) == 0.0
    assert rates.spend("b", 1.0, 5.0) == 0.0


def test_a_large_amount_is_admitted_and_paid_off() -> None:
    now = [0.0]
    rates = Rates(1.0, lambda: now[0])
    assert rates.spend("a", 1000.0, 100.0) == 0.0
    assert rates.spend("a", 1000.0, 100.0) == pytest.approx(10.0)
    spent = 1000.0
    while now[0] < 100.0:
        now[0] += 1.0
        spent += 1000.0 if rates.spend("a", 1000.0, 100.0) == 0.0 else 0.0
    assert spent / now[0] == pytest.approx(100.0, rel=0.12)


def test_buckets_do_not_grow_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("magic_server.quotas.MAX_BUCKETS", 10)
    rates = Rates(1.0)
    for number in range(100):
        rates.spend(f"caller {number}", 1.0, 1.0)
    assert len(rates._buckets) == 10


async def test_a_rate_refuses_says_how_long_and_admits_after_that(
    server_config: ServerConfig,
) -> None:
    config = with_quotas(server_config, agent_submaps_per_minute=0.1, burst_s=1.0)
    async with serving(config) as (server, client):
        await register(client)
        await client.submit_submap(make_submap(index=0))
        with pytest.raises(RateLimited) as caught:
            await client.submit_submap(make_submap(index=1))
        asked_s = caught.value.retry_after_s
        assert asked_s is not None
        assert 500.0 < asked_s <= 600.0
        now = server.quotas._rates._clock()
        server.quotas._rates._clock = lambda: now + asked_s
        assert not (await client.submit_submap(make_submap(index=1))).duplicate


async def test_the_client_waits_as_long_as_the_server_asks(server: Server) -> None:
    async with MagicClient(server.address, ClientConfig(backoff_s=0.001)) as client:
        refusals = [RateLimited("slow down", retry_after_s=0.2)] * 2
        loop = asyncio.get_running_loop()
        started = loop.time()

        async def attempt() -> str:
            if refusals:
                status = grpc_status_of(refusals.pop())
                raise grpc.aio.AioRpcError(
                    status.code,
                    grpc.aio.Metadata(),
                    grpc.aio.Metadata(*status.trailing_metadata),
                    details=status.details,
                )
            return "admitted"

        assert await client.retried(attempt) == "admitted"
        assert loop.time() - started >= 0.4


async def test_a_longer_wait_than_the_client_allows_is_an_error_at_once(
    server_config: ServerConfig,
) -> None:
    impatient = ClientConfig(max_asked_s=1.0)
    async with (
        Server(with_quotas(server_config, agent_submaps=1)) as server,
        MagicClient(server.address, impatient) as client,
    ):
        await register(client)
        await client.submit_submap(make_submap(index=0))
        with pytest.raises(QuotaExceeded) as caught:
            await client.submit_submap(make_submap(index=1))
        assert caught.value.retry_after_s == 60.0


async def test_calls_of_one_caller_are_limited(server_config: ServerConfig) -> None:
    config = with_quotas(server_config, calls_per_s=0.5, burst_s=6.0)
    async with serving(config) as (server, client):
        now = server.quotas._rates._clock()
        server.quotas._rates._clock = lambda: now  # nothing is earned back meanwhile
        for _ in range(3):
            await client.list_sessions()
        with pytest.raises(RateLimited, match="calls/s"):
            await client.list_sessions()


# Totals


async def test_an_agents_quota_holds_and_a_deletion_makes_room(server_config: ServerConfig) -> None:
    async with serving(with_quotas(server_config, agent_submaps=2)) as (_, client):
        await register(client)
        await register(client, 1)
        for index in (0, 1):
            await client.submit_submap(make_submap(index=index))
        with pytest.raises(QuotaExceeded, match="agent_0 would have 3 sub-maps, its quota is 2"):
            await client.submit_submap(make_submap(index=2))
        await client.submit_submap(make_submap(agent=1))
        assert (await client.submit_submap(make_submap(index=1))).duplicate
        await client.delete_submap("sessions/room/agents/agent_0/submaps/0", force=True)
        await client.submit_submap(make_submap(index=2))


async def test_a_sessions_bytes_are_counted_with_uploads_under_way(
    server_config: ServerConfig,
) -> None:
    submaps = [encode_submap(make_submap(agent=n), request_id=f"r{n}") for n in range(3)]
    sizes = [sum(blob.length for blob in one.header.blobs) for one in submaps]
    config = with_quotas(server_config, session_bytes=sum(sizes) - 1)
    async with serving(config) as (server, client):
        for agent in range(3):
            await register(client, agent)
        answers = await asyncio.gather(
            *(client.submit_encoded(one) for one in submaps), return_exceptions=True
        )
        refused = [answer for answer in answers if isinstance(answer, QuotaExceeded)]
        assert 1 <= len(refused) <= 2  # those that came together may all see each other
        stored = await client.list_submaps("room")
        assert len(stored) == 3 - len(refused)
        assert server.quotas.held_bytes == 0


async def test_agents_and_sessions_are_limited(server_config: ServerConfig) -> None:
    config = with_quotas(server_config, session_agents=2, sessions=2)
    async with serving(config) as (_, client):
        await register(client, 0)
        await register(client, 1)
        with pytest.raises(QuotaExceeded, match="3 agents"):
            await register(client, 2)
        await register(client, 1)
        await register(client, 0, "second")
        with pytest.raises(QuotaExceeded, match="3 sessions"):
            await register(client, 0, "third")


def test_a_quota_of_nothing_is_a_mistake() -> None:
    with pytest.raises(ConfigError, match=r"quotas\.agent_bytes"):
        QuotaConfig(agent_bytes=0)


# Queues


async def test_the_gate_holds_only_so_many() -> None:
    gate = Gate(max_calls=2, max_watches=1)
    with pytest.raises(Unavailable, match="starting"), gate.passing():
        pass
    gate.open()
    with gate.passing(), gate.passing(), gate.passing(watch=True):
        with pytest.raises(Overloaded, match="2 calls"), gate.passing():
            pass
        with pytest.raises(Overloaded, match="1 watches"), gate.passing(watch=True):
            pass
    assert await gate.empty(0.0)
    gate.drain()
    with pytest.raises(Unavailable, match="stopping"), gate.passing():
        pass


async def test_a_backlog_that_is_full_takes_no_more(server_config: ServerConfig) -> None:
    limits = dataclasses.replace(server_config.limits, session_backlog=1)
    config = dataclasses.replace(server_config, limits=limits, loops=LoopConfig(enabled=False))
    async with serving(config) as (server, client):
        await register(client)
        await register(client, 1)
        coordinator = await server.sessions.named("room")
        async with coordinator._editing:  # the search stands still
            await client.submit_submap(make_submap(agent=0))
            await client.submit_submap(make_submap(agent=1))
            with pytest.raises(Overloaded, match="this server keeps 1") as caught:
                await client.submit_submap(make_submap(agent=0, index=1))
        assert caught.value.retry_after_s
        await eventually(lambda: not coordinator.waiting_searches)
        await client.submit_submap(make_submap(agent=0, index=1))


async def test_merges_of_a_session_are_limited(server_config: ServerConfig) -> None:
    limits = dataclasses.replace(server_config.limits, open_operations=1)
    async with serving(dataclasses.replace(server_config, limits=limits)) as (_, client):
        await register(client)
        await client.submit_submap(make_submap())
        first = await client.start_global_map("room", coarse_only=True, request_id="one")
        with pytest.raises(Overloaded, match="1 merges"):
            await client.start_global_map("room", coarse_only=True, request_id="two")
        again = await client.start_global_map("room", coarse_only=True, request_id="one")
        assert again.name == first.name


def snapshot(revision: int, megabytes: int) -> mapping_pb.PoseSnapshot:
    """A solution of about so many megabytes."""
    poses = [
        mapping_pb.CorrectedPose(submap="x" * 1000, component="y" * 24)
        for _ in range(1000 * megabytes)
    ]
    return mapping_pb.PoseSnapshot(session="sessions/room", revision=revision, poses=poses)


async def test_a_stalled_watcher_holds_nothing_and_wakes_up_to_the_newest(
    server_config: ServerConfig,
) -> None:
    async with serving(server_config) as (server, client):
        await register(client)
        board = (await server.sessions.named("room")).board
        async with grpc.aio.insecure_channel(server.address) as channel:
            stub = mapping_grpc.MappingServiceStub(channel)
            request = mapping_pb.WatchCorrectedPosesRequest(session="sessions/room")
            call = stub.WatchCorrectedPoses(request, timeout=120)
            board.publish(snapshot(1, 1))
            assert (await call.read()).snapshot.revision == 1
            gc.collect()
            before = psutil.Process().memory_info().rss
            for revision in range(2, 152):  # 150 MB that nobody reads
                board.publish(snapshot(revision, 1))
                await asyncio.sleep(0.01)
            gc.collect()
            grown = psutil.Process().memory_info().rss - before
            assert grown < 40_000_000
            assert server.gate.watches == 1
            seen = []
            while not seen or seen[-1] < 151:
                seen.append((await call.read()).snapshot.revision)
            # What the connection's buffers held before it stalled, of 150; measured 4 to 7.
            assert len(seen) <= 20
            call.cancel()
        await eventually(lambda: server.gate.watches == 0)


# Disk and memory


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 24 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small file system needs root")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(disk: Path) -> Path:
    """Take every free byte."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(1 << 16)):
            pass
    return ballast


async def test_a_full_disk_refuses_cleanly_and_recovers(
    server_config: ServerConfig, small_disk: Path
) -> None:
    config = dataclasses.replace(
        server_config,
        data_dir=small_disk / "data",
        resources=ResourceConfig(min_free_bytes=0),
        loops=LoopConfig(enabled=False),
    )
    async with serving(config) as (server, client):
        await register(client)
        await register(client, 1)
        await client.submit_submap(make_submap(agent=0))
        coordinator = await server.sessions.named("room")
        assert await coordinator.idle(600)
        before = (await client.get_corrected_poses("room")).revision
        ballast = fill(small_disk)
        for _ in range(3):
            with pytest.raises(DiskFull) as caught:
                await client.submit_submap(make_submap(agent=1))
            assert caught.value.retry_after_s
        if not config.store.database:  # PostgreSQL has another disk
            with pytest.raises(DiskFull):
                await register(client, 2)
            assert len(await client.list_agents("room")) == 2
        assert len(await client.list_submaps("room")) == 1
        ballast.unlink()
        await client.submit_submap(make_submap(agent=1))
        assert await coordinator.idle(600)
        after = await client.get_corrected_poses("room")
        assert after.revision > before
        assert len(after.poses) == 2
    async with serving(config) as (_, client):
        assert len(await client.list_submaps("room")) == 2


async def test_what_was_computed_while_the_disk_was_full_is_stored_later(
    server_config: ServerConfig, small_disk: Path
) -> None:
    if server_config.store.database:
        pytest.skip("PostgreSQL has another disk")
    config = dataclasses.replace(
        server_config,
        data_dir=small_disk / "data",
        resources=ResourceConfig(min_free_bytes=0),
        loops=LoopConfig(enabled=False),
    )
    async with serving(config) as (server, client):
        await register(client)
        coordinator = await server.sessions.named("room")
        async with coordinator._editing:  # the search stands still while the disk fills
            await client.submit_submap(make_submap())
            ballast = fill(small_disk)
        await asyncio.sleep(0.5)
        assert coordinator.busy
        ballast.unlink()
        assert await coordinator.idle(600)
        assert len((await client.get_corrected_poses("room")).poses) == 1


async def test_a_reserve_is_kept_for_the_database(
    server_config: ServerConfig, small_disk: Path
) -> None:
    config = dataclasses.replace(
        server_config,
        data_dir=small_disk / "data",
        resources=ResourceConfig(min_free_bytes=1 << 30),
    )
    async with serving(config) as (_, client):
        await register(client)
        with pytest.raises(DiskFull, match="keeps 1073741824"):
            await client.submit_submap(make_submap())
        with pytest.raises(DiskFull):
            await client.start_global_map("room")
        assert stored_files(config) == []


async def test_low_memory_refuses_and_recovers(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    free = [1 << 30]
    with ThreadPoolExecutor(1) as threads:
        resources = Resources(
            tmp_path,
            ResourceConfig(min_available_bytes=1 << 28),
            threads=threads,
            measure=lambda _: Room(1 << 40, free[0]),
        )
        await resources.require(1000)
        free[0] = 1 << 20
        with pytest.raises(MemoryLow, match="begins nothing large below 268435456") as caught:
            await resources.require(1000)
        assert caught.value.retry_after_s
        free[0] = 1 << 29
        await resources.require(1000)


async def test_a_server_without_memory_takes_no_submaps_but_answers(
    server_config: ServerConfig,
) -> None:
    resources = ResourceConfig(min_available_bytes=1 << 60)
    config = dataclasses.replace(server_config, resources=resources)
    async with serving(config) as (_, client):
        await register(client)
        with pytest.raises(MemoryLow):
            await client.submit_submap(make_submap())
        with pytest.raises(MemoryLow):
            await client.start_global_map("room")
        assert await client.list_submaps("room") == ()


def test_the_limit_of_a_container_counts(tmp_path: Path) -> None:
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("900000\n")
    (tmp_path / "memory.stat").write_text("anon 800000\ninactive_file 50000\n")
    assert available_memory(tmp_path) == 150_000
    (tmp_path / "memory.max").write_text("max\n")
    assert available_memory(tmp_path) > 1_000_000


async def test_a_submap_above_the_limits_is_refused_for_good(server_config: ServerConfig) -> None:
    limits = ServiceLimits(submap=dataclasses.replace(server_config.limits.submap, max_bytes=1000))
    async with serving(dataclasses.replace(server_config, limits=limits)) as (_, client):
        await register(client)
        with pytest.raises(ResourceExhausted, match="this server takes 1000") as caught:
            await client.submit_submap(make_submap())
        assert caught.value.retry_after_s is None


async def test_a_call_that_runs_out_of_memory_is_refused_for_now(
    server: Server, client: MagicClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def greedy(**_: object) -> None:
        bytearray(1 << 62)

    with monkeypatch.context() as patched:
        patched.setattr(server._store.agents, "session_page", greedy)
        async with MagicClient(server.address, NO_RETRY) as impatient:
            with pytest.raises(MemoryLow) as caught:
                await impatient.list_sessions()
    assert caught.value.retry_after_s
    assert await client.list_sessions() == ()


@pytest.mark.slow
async def test_a_server_whose_memory_is_taken_refuses_and_recovers(
    server_config: ServerConfig,
) -> None:
    """With real memory: 3 GB are taken and given back."""
    available = available_memory()
    if available < 8 << 30:
        pytest.skip("needs 8 GB of free memory")
    resources = ResourceConfig(min_available_bytes=available - (3 << 29))
    async with serving(dataclasses.replace(server_config, resources=resources)) as (_, client):
        await register(client)
        ballast = bytearray(os.urandom(1 << 20)) * 3072
        with pytest.raises(MemoryLow):
            await client.submit_submap(make_submap())
        assert await client.list_submaps("room") == ()
        del ballast
        await client.submit_submap(make_submap())
