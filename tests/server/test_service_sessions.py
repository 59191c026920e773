"""Sessions, agents, listing, operations of the process itself: what is read without mapping."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import sqlite3

import grpc
import grpc.aio
import pytest
from google.protobuf import descriptor_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import (
    ConfigError,
    DescriptorModelMismatch,
    InvalidInput,
    MagicError,
    NotFound,
    Unavailable,
    WrongState,
)
from magic_core.wire import error_of
from magic_server.config import ListenConfig, ServerConfig
from magic_server.server import SERVICES, Server
from tests.small_world import DIMENSION, MODEL_ID, make_submap


async def register(client: MagicClient, agent: str = "agent_0", session: str = "room"):
    return await client.register_agent(session, agent, model_id=MODEL_ID, dimension=DIMENSION)


async def test_an_agent_that_registers_again_resumes(client: MagicClient) -> None:
    first = await register(client)
    assert (first.resumed, first.next_submap_index, first.revision) == (False, 0, 0)
    await client.submit_submap(make_submap())
    again = await register(client)
    assert (again.resumed, again.next_submap_index) == (True, 1)
    assert len(await client.list_agents("room")) == 1


async def test_a_finished_agent_does_not_register_again(client: MagicClient) -> None:
    await register(client)
    assert await client.finish_agent("room", "agent_0") == 0
    assert await client.finish_agent("room", "agent_0") == 0  # idempotent
    assert (await client.get_agent("room", "agent_0")).state == "FINISHED"
    with pytest.raises(WrongState, match="another agent name"):
        await register(client)


async def test_a_session_pins_its_descriptor_model(client: MagicClient) -> None:
    await register(client)
    for model_id, dimension in (("other", DIMENSION), (MODEL_ID, 7)):
        with pytest.raises(DescriptorModelMismatch, match=f"{MODEL_ID}.*{model_id}"):
            await client.register_agent("room", "agent_1", model_id=model_id, dimension=dimension)
    await client.register_agent("hall", "agent_1", model_id="other", dimension=7)
    assert [agent.name for agent in await client.list_agents("room")] == [
        "sessions/room/agents/agent_0"
    ]


@pytest.mark.parametrize(
    ("arguments", "fields"),
    [
        ({"agent": "no/slashes"}, {"agent"}),
        ({"session": ".."}, {"agent"}),
        ({"model_id": ""}, {"descriptor_model_id"}),
        ({"dimension": 0}, {"descriptor_dimension"}),
        ({"dimension": 9000, "request_id": "x" * 129}, {"descriptor_dimension", "request_id"}),
    ],
)
async def test_a_wrong_registration_names_its_fields(
    client: MagicClient, arguments: dict, fields: set[str]
) -> None:
    right = {"session": "room", "agent": "a", "model_id": MODEL_ID, "dimension": DIMENSION}
    asked = right | arguments
    session, agent = asked.pop("session"), asked.pop("agent")
    with pytest.raises(InvalidInput) as caught:
        await client.register_agent(session, agent, **asked)
    assert {violation.field for violation in caught.value.violations} == fields
    assert await client.list_sessions() == ()


async def test_what_does_not_exist_is_not_found(client: MagicClient) -> None:
    await register(client)
    for missing in (
        client.get_session("hall"),
        client.get_agent("room", "agent_9"),
        client.get_submap("sessions/room/agents/agent_0/submaps/0"),
        client.download_submap("sessions/room/agents/agent_0/submaps/0"),
        client.get_corrected_poses("hall"),
        client.get_corrected_poses("room", agent="agent_9"),
        client.get_trajectory("room", "agent_9"),
        client.query_loops("sessions/room/agents/agent_0/submaps/0"),
        client.list_loops("hall"),
        client.list_agents("hall"),
        client.list_submaps("room", agent="agent_9"),
        client.list_operations("hall"),
        client.get_operation("sessions/room/operations/1"),
        client.get_global_map("sessions/room"),
        client.get_global_map("sessions/room/maps/1"),
        client.start_global_map("hall"),
        client.finish_agent("room", "agent_9"),
        client.delete_session("hall"),
        client.delete_agent("room", "agent_9"),
        client.delete_submap("sessions/room/agents/agent_0/submaps/0"),
    ):
        with pytest.raises(NotFound):
            await missing


async def test_a_session_without_submaps_has_revision_zero(client: MagicClient) -> None:
    await register(client)
    snapshot = await client.get_corrected_poses("room")
    assert (snapshot.session, snapshot.revision) == ("sessions/room", 0)
    assert (snapshot.poses, snapshot.solved_at) == ({}, None)


async def test_pages_hold_everything_once_in_order(server: Server, client: MagicClient) -> None:
    for number in range(5):
        await register(client, f"agent_{number}")
    async with grpc.aio.insecure_channel(server.address) as channel:
        stub = session_grpc.SessionServiceStub(channel)
        found, token, pages = [], "", 0
        while pages == 0 or token:
            request = session_pb.ListAgentsRequest(
                session="sessions/room", page_size=2, page_token=token
            )
            page = await stub.ListAgents(request, timeout=60)
            found += [agent.name.rpartition("_")[2] for agent in page.agents]
            token, pages = page.next_page_token, pages + 1
        assert (found, pages) == (["0", "1", "2", "3", "4"], 3)
        for request in (
            session_pb.ListAgentsRequest(session="sessions/room", page_size=1001),
            session_pb.ListAgentsRequest(session="sessions/room", page_token="nonsense"),
        ):
            with pytest.raises(grpc.RpcError) as caught:
                await stub.ListAgents(request, timeout=60)
            assert isinstance(error_of(caught.value), InvalidInput)


async def test_summaries_say_what_was_submitted(client: MagicClient) -> None:
    await register(client)
    submap = make_submap()
    receipt = await client.submit_submap(submap)
    info, header = await client.get_submap(submap.name)
    assert (await client.list_submaps("room", agent="agent_0")) == (info,)
    assert info.name == header.name == submap.name
    assert info.received_at == receipt.received_at
    assert (info.frame_count, info.keyframe_count) == (4, 2)
    assert info.gaussian_count == len(submap.gaussians)
    assert info.stored_bytes == receipt.stored_bytes
    assert info.last_timestamp_s == submap.trajectory[-1].timestamp_s
    session = await client.get_session("room")
    assert (await client.list_sessions()) == (session,)
    assert (session.agent_count, session.submap_count) == (1, 1)
    assert (session.descriptor_model_id, session.descriptor_dimension) == (MODEL_ID, DIMENSION)
    assert session.stored_bytes == receipt.stored_bytes


async def test_health_and_reflection_know_every_service(server: Server) -> None:
    async with grpc.aio.insecure_channel(server.address) as channel:
        health = health_pb2_grpc.HealthStub(channel)
        for name in ("", *SERVICES):
            answer = await health.Check(health_pb2.HealthCheckRequest(service=name), timeout=60)
            assert answer.status == health_pb2.HealthCheckResponse.SERVING
        stub = reflection_pb2_grpc.ServerReflectionStub(channel)
        asked = [reflection_pb2.ServerReflectionRequest(list_services="")] + [
            reflection_pb2.ServerReflectionRequest(file_containing_symbol=name) for name in SERVICES
        ]
        answers = [answer async for answer in stub.ServerReflectionInfo(iter(asked), timeout=60)]
        listed = {service.name for service in answers[0].list_services_response.service}
        assert {*SERVICES, "grpc.health.v1.Health"} <= listed
        for name, answer in zip(SERVICES, answers[1:], strict=True):
            data = answer.file_descriptor_response.file_descriptor_proto[0]
            file = descriptor_pb2.FileDescriptorProto.FromString(data)
            assert name in {f"{file.package}.{service.name}" for service in file.service}


async def test_every_rpc_has_a_client_method() -> None:
    from magicslam.v1 import global_map_service_pb2, mapping_service_pb2, session_service_pb2

    methods = {
        "BuildGlobalMap": ("start_global_map", "build_global_map"),
        "GetGlobalMap": ("get_global_map", "download_global_map"),
        "DownloadSubmap": ("download_submap", "download_encoded"),
        "SubmitSubmap": ("submit_submap", "submit_encoded"),
    }
    for file in (global_map_service_pb2, mapping_service_pb2, session_service_pb2):
        for service in file.DESCRIPTOR.services_by_name.values():
            for rpc in service.methods_by_name:
                snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in rpc).lstrip("_")
                for name in methods.get(rpc, (snake,)):
                    assert callable(getattr(MagicClient, name, None)), f"{rpc}: {name} is missing"


async def test_a_client_without_a_server_says_where_it_looked(unused_tcp_port: int) -> None:
    target = f"127.0.0.1:{unused_tcp_port}"
    with pytest.raises(Unavailable, match=target):
        async with MagicClient(target, ClientConfig(connect_timeout_s=0.3)):
            pass


async def test_idempotent_calls_wait_for_a_server_that_comes_back(
    server_config: ServerConfig,
) -> None:
    first = Server(server_config)
    await first.start()
    patient = ClientConfig(attempts=1000, max_backoff_s=0.5)
    async with MagicClient(first.address, patient) as client:
        await register(client)
        await first.stop()
        listen = ListenConfig(port=first.port)
        second = Server(dataclasses.replace(server_config, listen=listen))
        asked = asyncio.create_task(client.list_agents("room"))
        await asyncio.sleep(0.1)
        assert not asked.done()
        async with second:
            assert len(await asked) == 1


async def test_two_servers_never_share_a_folder(server: Server) -> None:
    if server.config.store.database:
        pytest.skip("servers of one database share their folder")
    with pytest.raises(WrongState, match="in use by another server"):
        async with Server(server.config):
            pass
    async with MagicClient(server.address) as client:  # the first one is unharmed
        await register(client)


async def test_a_taken_port_is_named(server: Server, server_config: ServerConfig, tmp_path) -> None:
    taken = ServerConfig(data_dir=tmp_path / "other", listen=ListenConfig(port=server.port))
    with pytest.raises(Unavailable, match=str(server.port)):
        async with Server(taken):
            pass


def test_plain_text_stays_on_this_machine_unless_told() -> None:
    with pytest.raises(ConfigError, match=r"tls\.certificate"):
        ServerConfig(listen=ListenConfig(host="0.0.0.0"))
    assert ServerConfig(listen=ListenConfig(host="0.0.0.0", insecure=True)).listen.insecure


async def test_an_unexpected_failure_is_internal_and_tells_no_secrets(
    server: Server, client: MagicClient
) -> None:
    if server.config.store.database:
        pytest.skip("the same on every engine")
    with contextlib.closing(sqlite3.connect(server.config.data_dir / "magic.sqlite")) as database:
        database.execute("DROP TABLE loops")
    with pytest.raises(MagicError, match="INTERNAL: internal error, incident") as caught:
        await client.list_sessions()
    assert "loops" not in str(caught.value)
