"""A request that is repeated gets its first answer, also from a server that was started again."""

from __future__ import annotations

import pytest
from google.protobuf.descriptor import MethodDescriptor
from magicslam.v1 import global_map_service_pb2, mapping_service_pb2, session_service_pb2

from magic_agent.client import MagicClient
from magic_core.errors import AlreadyExists, WrongState
from magic_core.wire.records import AgentRegistration
from magic_server.access import RULES
from magic_server.config import ServerConfig
from magic_server.server import Server
from tests.small_world import DIMENSION, MODEL_ID, make_submap


async def register(
    client: MagicClient, request_id: str, *, agent: str = "agent_0", model_id: str = MODEL_ID
) -> AgentRegistration:
    return await client.register_agent(
        "room", agent, model_id=model_id, dimension=DIMENSION, request_id=request_id
    )


async def test_registration_repeated_gets_the_first_answer(server_config: ServerConfig) -> None:
    async with Server(server_config) as server, MagicClient(server.address) as client:
        first = await register(client, "r")
        assert (first.resumed, first.next_submap_index) == (False, 0)
        await client.submit_submap(make_submap())
        assert await register(client, "r") == first
        later = await register(client, "another")
        assert (later.resumed, later.next_submap_index) == (True, 1)
    async with Server(server_config) as server, MagicClient(server.address) as client:
        assert await register(client, "r") == first
        await client.finish_agent("room", "agent_0")
        assert await register(client, "r") == first
        with pytest.raises(WrongState, match="finished"):
            await register(client, "third")


async def test_finishing_repeated_gets_the_first_answer(server_config: ServerConfig) -> None:
    async with Server(server_config) as server, MagicClient(server.address) as client:
        await register(client, "r")
        await client.submit_submap(make_submap())
        assert await client.finish_agent("room", "agent_0", request_id="f") == 1
    async with Server(server_config) as server, MagicClient(server.address) as client:
        assert await client.finish_agent("room", "agent_0", request_id="f") == 1


async def test_a_request_id_is_not_used_for_something_else(client: MagicClient) -> None:
    await register(client, "r")
    with pytest.raises(AlreadyExists, match="'r' was used for another request"):
        await client.finish_agent("room", "agent_0", request_id="r")
    assert (await client.list_agents("room"))[0].state == "ACTIVE"
    await register(client, "r", agent="agent_1")  # another agent chooses its own ids


async def test_an_operation_repeated_is_the_first_one(server_config: ServerConfig) -> None:
    async with Server(server_config) as server, MagicClient(server.address) as client:
        await register(client, "r")
        first = await client.start_global_map("room", request_id="map", drain_timeout_s=0.1)
    async with Server(server_config) as server, MagicClient(server.address) as client:
        again = await client.start_global_map("room", request_id="map", drain_timeout_s=0.1)
        assert again.name == first.name
        assert again.created_at == first.created_at
        with pytest.raises(AlreadyExists, match="another map"):
            await client.start_global_map("room", request_id="map", coarse_only=True)
        assert len(await client.list_operations("room")) == 1


def _methods() -> dict[str, MethodDescriptor]:
    files = (global_map_service_pb2, mapping_service_pb2, session_service_pb2)
    services = [one for file in files for one in file.DESCRIPTOR.services_by_name.values()]
    return {
        f"/{service.full_name}/{method.name}": method
        for service in services
        for method in service.methods
    }


def test_every_call_that_changes_what_is_stored_carries_a_request_id() -> None:
    methods = _methods()
    changing = [method for path, method in methods.items() if RULES[path].mutates]
    assert len(changing) >= 9
    for method in changing:
        fields = method.input_type.fields_by_name
        header = fields["header"].message_type if "header" in fields else None
        carrier = header or method.input_type
        assert "request_id" in carrier.fields_by_name, method.full_name
