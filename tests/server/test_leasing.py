"""Several servers on one database: each session has one, and moves when that one is lost."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path

import grpc
import pytest
import sqlalchemy as sa
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import ConfigError, HeldElsewhere, NotFound
from magic_core.wire import encode_submap, error_of
from magic_server.cluster_config import ClusterConfig
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from magic_server.store import schema
from magic_server.store_config import StoreConfig
from tests.postgresql import PostgresServer
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually

LEASE_S = 8.0
"""No machine stands still for so long; a lost lease is noticed in a quarter of it."""
CLIENT = ClientConfig(rpc_timeout_s=60.0)
ONCE = dataclasses.replace(CLIENT, attempts=1)


@pytest.fixture
async def servers(postgresql: PostgresServer, tmp_path: Path) -> AsyncIterator[list[Server]]:
    """Two servers of one database."""
    database = postgresql.database()
    async with AsyncExitStack() as stack:
        started = []
        for name in ("a", "b"):
            config = ServerConfig(
                data_dir=tmp_path,
                store=StoreConfig(database=database),
                cluster=ClusterConfig(replica=name, lease_s=LEASE_S),
                listen=ListenConfig(port=0, stop_grace_s=1.0),
                jobs=JobConfig(workers=1, niceness=0),
                loops=LoopConfig(enabled=False),
            )
            started.append(await stack.enter_async_context(Server(config)))
        yield started


def target_of(servers: list[Server]) -> str:
    return ",".join(server.address for server in servers)


def in_turn(servers: list[Server]) -> tuple[Server, Server]:
    """The server that has the session, and the other one: a client of both goes to whichever
    answers first."""
    first, second = servers
    return (first, second) if first.sessions.found("room") else (second, first)


async def register(client: MagicClient, session: str = "room", agent: str = "agent_0"):
    return await client.register_agent(session, agent, model_id=MODEL_ID, dimension=DIMENSION)


async def fall_silent(server: Server) -> None:
    """As a server that has hung for a while: its leases have ended, it looks for no session."""
    assert server._leasing is not None
    await server._leasing._renewing.close()
    await server._leasing._looking.close()
    await end_leases(server)


async def end_leases(server: Server) -> None:
    """As if all leases had been taken long ago."""
    async with server._store._database.write() as connection:
        await connection.execute(sa.update(schema.leases).values(expires_at=1.0))


async def take_over(server: Server) -> None:
    """As if the holder had not been heard of for a while: it goes on renewing, too late."""
    assert server._leasing is not None
    session = await server._store.agents.session("room")
    async with asyncio.timeout(60):
        while True:
            await end_leases(server)
            with contextlib.suppress(HeldElsewhere):  # it was just in time
                return await server._leasing._take(session)


async def test_a_call_for_a_session_elsewhere_names_its_server(servers: list[Server]) -> None:
    a, b = servers
    async with MagicClient(a.address, CLIENT) as first, MagicClient(b.address, ONCE) as second:
        await register(first)
        request = mapping_pb.GetCorrectedPosesRequest(session="sessions/room")
        with pytest.raises(grpc.RpcError) as refused:
            await second.mapping_stub.GetCorrectedPoses(request, timeout=60)
        error = error_of(refused.value)
        assert isinstance(error, HeldElsewhere)
        assert error.holder == a.address
        assert a.address in str(error)
        # What is stored is read anywhere, and a name that is none is what it always was.
        assert [info.name for info in await second.list_sessions()] == ["sessions/room"]
    async with MagicClient(b.address, ONCE) as second:
        assert len(await second.list_agents("room")) == 1
        with pytest.raises(NotFound):
            await second.get_corrected_poses("nowhere")


async def test_a_client_that_knows_one_server_follows_the_session(servers: list[Server]) -> None:
    a, b = servers
    async with MagicClient(a.address, CLIENT) as first:
        await register(first)
    async with MagicClient(b.address, CLIENT) as second:
        assert (await register(second)).resumed
        receipt = await second.submit_submap(make_submap())
        assert not receipt.duplicate
    assert a.sessions.found("room") is not None
    assert b.sessions.found("room") is None


async def test_sessions_of_a_silent_server_move_and_it_cannot_write(
    servers: list[Server],
) -> None:
    encoded = [encode_submap(make_submap(index=i), request_id=f"r{i}") for i in range(2)]
    async with MagicClient(target_of(servers), CLIENT) as client:
        await register(client)
        a, b = in_turn(servers)
        await client.submit_encoded(encoded[0])
        session = (await a.sessions.named("room")).session
        await fall_silent(a)
        await eventually(lambda: b.sessions.found("room") is not None)
        with pytest.raises(HeldElsewhere):
            async with a._store._database.write(session.id):
                pass
        # The silent server still answers, until it asks the database.
        await client.submit_encoded(encoded[1])
        stored = [info.name for info in await client.list_submaps("room")]
        assert stored == [one.header.name for one in encoded]
        coordinator = await b.sessions.named("room")
        assert await coordinator.idle(600)
        assert len((await client.get_corrected_poses("room")).poses) == 2


async def test_a_lease_that_another_server_took_ends_the_work_here(servers: list[Server]) -> None:
    async with MagicClient(target_of(servers), CLIENT) as client:
        await register(client)
        holder, other = in_turn(servers)
        watching = asyncio.create_task(anext(client.watch_corrected_poses("room")))
        await eventually(lambda: holder.gate.watches == 1)
        await take_over(other)
        await eventually(lambda: holder.sessions.found("room") is None)
        # The watcher was sent on, and sees what happens there.
        await client.submit_submap(make_submap())
        assert len((await asyncio.wait_for(watching, 60)).poses) == 1
        assert other.gate.watches == 1


async def test_a_server_that_stops_hands_its_sessions_over_at_once(servers: list[Server]) -> None:
    async with MagicClient(target_of(servers), CLIENT) as client:
        await register(client)
        a, b = in_turn(servers)
        await client.submit_submap(make_submap())
        await a.stop()
        await eventually(lambda: b.sessions.found("room") is not None)
        await client.submit_submap(make_submap(index=1))
        assert (await client.finish_agent("room", "agent_0")) == 2


@pytest.mark.slow
async def test_a_merge_goes_on_where_its_session_goes(servers: list[Server]) -> None:
    async with MagicClient(target_of(servers), CLIENT) as client:
        await register(client)
        a, b = in_turn(servers)
        await client.submit_submap(make_submap())
        session = await a._store.agents.session("room")
        assert await (await a.sessions.named("room")).idle(600)
        await client.finish_agent("room", "agent_0")
        await client.start_global_map("room", coarse_only=True)
        await fall_silent(a)
        await a._maps.forget(session)  # what it was merging is lost with it
        await eventually(lambda: b.sessions.found("room") is not None)
        (status,) = await client.list_operations("room")
        assert (await client.wait_operation(status)).error is None


async def test_a_session_that_is_deleted_is_free_for_any_server(servers: list[Server]) -> None:
    a, b = servers
    async with MagicClient(a.address, CLIENT) as first, MagicClient(b.address, CLIENT) as second:
        await register(first)
        await second.delete_session("room", force=True)  # follows it
        async with MagicClient(b.address, CLIENT) as third:
            assert not (await register(third)).resumed
    assert b.sessions.found("room") is not None


def test_a_list_of_servers_has_no_gaps() -> None:
    with pytest.raises(ConfigError, match="HOST:PORT"):
        MagicClient("a:1,,b:2")


@pytest.mark.parametrize("wrong", [{"replica": "a/b"}, {"address": "nowhere"}, {"lease_s": 0.1}])
def test_settings_of_a_cluster_are_checked(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=f"cluster.{next(iter(wrong))}"):
        ClusterConfig(**wrong)
