"""Deleting sub-maps, agents and sessions: what goes, what stays, and that a repeat is harmless."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator
from pathlib import Path

import grpc
import grpc.aio
import numpy as np
import pytest
import pytest_asyncio
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import AlreadyExists, InvalidInput, NotFound, WrongState
from magic_core.geometry import se3
from magic_core.submap import OdometryEdge
from magic_core.wire import error_of
from magic_server.bridging import joined
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from magic_server.store import AgentRow, FirstAnswer
from tests.postgresql import NewStore
from tests.small_world import DIMENSION, MODEL_ID, make_submap, path
from tests.stored import stored_files
from tests.waiting import eventually

pytestmark = pytest.mark.asyncio(loop_scope="module")

SUBMAPS = 4


@pytest.fixture(scope="module")
def config(
    tmp_path_factory: pytest.TempPathFactory, new_store: NewStore, jobs: JobConfig
) -> ServerConfig:
    """Without loops, so that a session's graph is its odometry."""
    return ServerConfig(
        data_dir=tmp_path_factory.mktemp("delete"),
        store=new_store(),
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        jobs=jobs,
        loops=LoopConfig(enabled=False),
    )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server(config: ServerConfig) -> AsyncIterator[Server]:
    """One server for the whole file: each test leaves it without a session."""
    async with Server(config) as running:
        yield running


@pytest_asyncio.fixture(loop_scope="module")
async def client(server: Server) -> AsyncIterator[MagicClient]:
    """A client of that server, which is empty again afterwards, files included."""
    async with MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as connected:
        yield connected
        for session in await connected.list_sessions():
            await connected.delete_session(session.name.rpartition("/")[2], force=True)
    assert blobs(server) == set()


def name_of(index: int, agent: int = 0) -> str:
    return f"sessions/room/agents/agent_{agent}/submaps/{index}"


async def fill(
    client: MagicClient, *, agent: int = 0, submaps: int = SUBMAPS, known_start: bool = False
) -> None:
    """One agent's walk, finished."""
    await client.register_agent("room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION)
    for index in range(submaps):
        submap = make_submap(agent=agent, index=index, submaps=SUBMAPS, known_start=known_start)
        await client.submit_submap(submap)
    await client.finish_agent("room", f"agent_{agent}")


async def settled(server: Server, client: MagicClient):
    """The newest solution once there is nothing left to do."""
    assert await (await server.sessions.named("room")).idle(timeout_s=600)
    return await client.get_corrected_poses("room")


def blobs(server: Server) -> set[str]:
    return set(stored_files(server.config))


async def digests(client: MagicClient, name: str) -> set[str]:
    _, header = await client.get_submap(name)
    return {blob.sha256.hex() for blob in header.blobs}


async def test_a_deleted_submap_is_gone_everywhere_and_its_neighbours_stay_where_they_were(
    server: Server, client: MagicClient
) -> None:
    await fill(client)
    before = await settled(server, client)
    gone, kept = await digests(client, name_of(1)), await digests(client, name_of(2))
    answer = await client.delete_submap(name_of(1))
    assert answer.submap_count == 1
    assert answer.freed_bytes > 0
    at_once = await client.get_corrected_poses("room")
    assert at_once.revision > before.revision
    assert name_of(1) not in at_once.poses

    after = await settled(server, client)
    assert after.revision > at_once.revision
    assert list(after.poses) == [name_of(0), name_of(2), name_of(3)]
    (component,) = after.components
    assert (component.id, component.submap_count) == (name_of(0), 3)
    truth = path(0, SUBMAPS)
    for index in (2, 3):
        expected = se3.inverse(truth[0]) @ truth[index]
        pose = after.poses[name_of(index)].world_from_anchor
        np.testing.assert_allclose(pose, expected, atol=1e-6)
    assert blobs(server).isdisjoint(gone - kept)
    assert kept <= blobs(server)
    for missing in (client.get_submap(name_of(1)), client.download_submap(name_of(1))):
        with pytest.raises(NotFound):
            await missing
    nearest = await client.query_loops(
        make_submap(index=1, submaps=SUBMAPS).descriptor, session="room"
    )
    assert name_of(1) not in [c.target for c in nearest.candidates]
    info = await client.get_agent("room", "agent_0")
    assert (info.submap_count, info.next_submap_index) == (3, 4)


async def test_what_was_deleted_stays_deleted_in_a_server_started_again(
    config: ServerConfig, tmp_path: Path, new_store: NewStore
) -> None:
    config = dataclasses.replace(config, data_dir=tmp_path, store=new_store())
    async with Server(config) as server, MagicClient(server.address) as client:
        await fill(client)
        await client.delete_submap(name_of(2))
    async with Server(config) as server, MagicClient(server.address) as client:
        stored = [info.name for info in await client.list_submaps("room")]
        assert stored == [name_of(0), name_of(1), name_of(3)]
        # The graph that was rebuilt still knows how 3 lies to 1.
        coordinator = await server.sessions.named("room")
        last = coordinator.graph.online.odometry_of(name_of(3))
        truth = path(0, SUBMAPS)
        assert last.source == name_of(1)
        np.testing.assert_allclose(
            last.source_from_target, se3.inverse(truth[1]) @ truth[3], atol=1e-6
        )


async def test_the_oldest_submap_of_a_component_hands_over_name_and_frame(
    server: Server, client: MagicClient
) -> None:
    await fill(client)
    await settled(server, client)
    await client.delete_submap(name_of(0))
    truth = path(0, SUBMAPS)
    for snapshot in (await client.get_corrected_poses("room"), await settled(server, client)):
        (component,) = snapshot.components
        assert component.id == name_of(1)
        pose = snapshot.poses[name_of(3)].world_from_anchor
        np.testing.assert_allclose(pose, se3.inverse(truth[1]) @ truth[3], atol=1e-6)


async def test_a_known_start_outlives_the_submap_that_had_it(
    server: Server, client: MagicClient
) -> None:
    await fill(client, known_start=True)
    await settled(server, client)
    await client.delete_submap(name_of(0))
    truth = path(0, SUBMAPS)
    for snapshot in (await client.get_corrected_poses("room"), await settled(server, client)):
        for index in (1, 3):
            pose = snapshot.poses[name_of(index)].world_from_anchor
            np.testing.assert_allclose(pose, truth[index], atol=1e-6)


async def test_blobs_that_another_submap_shares_are_kept(
    server: Server, client: MagicClient
) -> None:
    await fill(client, submaps=1)
    twin = dataclasses.replace(make_submap(submaps=SUBMAPS), agent="agent_1")
    await client.register_agent("room", "agent_1", model_id=MODEL_ID, dimension=DIMENSION)
    await client.submit_submap(twin)
    assert (await client.delete_submap(name_of(0))).freed_bytes == 0
    copy = await client.download_submap(twin.name)
    np.testing.assert_allclose(copy.anchor.depth, twin.anchor.depth, atol=0.0006)
    assert (await client.delete_submap(twin.name, force=True)).freed_bytes > 0
    assert blobs(server) == set()


async def test_an_agent_that_may_still_submit_protects_what_it_sent(client: MagicClient) -> None:
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    await client.submit_submap(make_submap(submaps=SUBMAPS))
    for refused in (
        client.delete_submap(name_of(0)),
        client.delete_agent("room", "agent_0"),
        client.delete_session("room"),
    ):
        with pytest.raises(WrongState, match=r"agent_0 has not finished.*force"):
            await refused
    assert len(await client.list_submaps("room")) == 1


async def test_an_agent_goes_on_behind_a_submap_that_was_deleted_by_force(
    server: Server, client: MagicClient
) -> None:
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    for index in range(2):
        await client.submit_submap(make_submap(index=index, submaps=SUBMAPS))
    await client.delete_submap(name_of(1), force=True)
    again = await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    assert again.next_submap_index == 2
    # Its upload, repeated because the answer was lost, gets the first answer and stores nothing.
    assert (await client.submit_submap(make_submap(index=1, submaps=SUBMAPS))).duplicate
    with pytest.raises(AlreadyExists):
        await client.submit_submap(make_submap(index=1, submaps=SUBMAPS), request_id="other")
    await client.submit_submap(make_submap(index=2, submaps=SUBMAPS))  # its odometry names 1
    after = await settled(server, client)
    assert list(after.poses) == [name_of(0), name_of(2)]
    assert len(after.components) == 1
    truth = path(0, SUBMAPS)
    pose = after.poses[name_of(2)].world_from_anchor
    np.testing.assert_allclose(pose, se3.inverse(truth[0]) @ truth[2], atol=1e-6)


async def test_a_deleted_agent_leaves_its_name_free_and_others_alone(
    server: Server, client: MagicClient
) -> None:
    await fill(client, submaps=2)
    await fill(client, agent=1, submaps=2)
    await settled(server, client)
    assert (await client.delete_agent("room", "agent_0")).submap_count == 2
    after = await settled(server, client)
    assert list(after.poses) == [name_of(0, 1), name_of(1, 1)]
    with pytest.raises(NotFound):
        await client.get_agent("room", "agent_0")
    await fill(client, submaps=1)
    assert name_of(0) in (await settled(server, client)).poses


async def test_a_deleted_session_leaves_nothing_but_its_name_free(
    server: Server, client: MagicClient
) -> None:
    await fill(client, submaps=2)
    await settled(server, client)
    await client.build_global_map("room", coarse_only=True)
    watcher = asyncio.create_task(anext(client.watch_corrected_poses("room", after_revision=99)))
    await asyncio.sleep(0.2)
    assert (await client.delete_session("room")).submap_count == 2
    with pytest.raises(NotFound, match="sessions/room"):
        await watcher
    assert await client.list_sessions() == ()
    assert blobs(server) == set()
    with pytest.raises(NotFound):
        await client.get_corrected_poses("room")
    await client.register_agent("room", "agent_0", model_id="another", dimension=3)
    assert (await client.get_session("room")).descriptor_model_id == "another"
    assert (await client.get_corrected_poses("room")).revision == 0
    assert await client.list_operations("room") == ()


async def test_a_map_goes_with_a_submap_that_it_was_merged_from(
    server: Server, client: MagicClient
) -> None:
    await fill(client, submaps=2)
    await settled(server, client)
    info = await client.build_global_map("room", coarse_only=True)
    await client.delete_submap(name_of(1))
    with pytest.raises(NotFound):
        await client.get_global_map(info.name)
    (operation,) = await client.list_operations("room")
    assert operation.state == "FAILED"
    assert operation.error is not None
    assert name_of(1) in operation.error.message
    assert blobs(server) == await digests(client, name_of(0))


async def test_a_deletion_is_done_once_for_one_request_id(client: MagicClient) -> None:
    await fill(client, submaps=2)
    for delete in (
        lambda request: client.delete_submap(name_of(0), request_id=request),
        lambda request: client.delete_agent("room", "agent_0", request_id=request),
        lambda request: client.delete_session("room", request_id=request),
    ):
        first = await delete("one")
        assert await delete("one") == first
        with pytest.raises(NotFound):
            await delete("two")


async def test_concurrent_deletions_of_one_thing_delete_it_once(client: MagicClient) -> None:
    await fill(client, submaps=2)
    answers = await asyncio.gather(
        *(client.delete_submap(name_of(1)) for _ in range(4)), return_exceptions=True
    )
    assert sum(not isinstance(answer, BaseException) for answer in answers) == 1
    assert sum(isinstance(answer, NotFound) for answer in answers) == 3


async def test_an_agent_that_is_deleted_while_it_submits_is_not_found(
    server: Server, client: MagicClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    await client.submit_submap(make_submap(index=0, submaps=2))
    answer = server._store.submaps.first_answer

    async def deleted_before(agent: AgentRow, index: int) -> FirstAnswer | None:
        if index == 0:  # asked for when sub-map 1 has said that it comes after it
            await client.delete_agent("room", "agent_0", force=True)
        return await answer(agent, index)

    monkeypatch.setattr(server._store.submaps, "first_answer", deleted_before)
    with pytest.raises(NotFound, match="agent_0"):
        await client.submit_submap(make_submap(index=1, submaps=2))


async def test_uploads_and_deletions_at_the_same_time_leave_no_file_that_nothing_refers_to(
    server: Server, client: MagicClient
) -> None:
    async def one(agent: int) -> None:
        await client.register_agent(
            "room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION
        )
        for index in range(SUBMAPS):
            await client.submit_submap(make_submap(agent=agent, index=index, submaps=SUBMAPS))

    async def delete(agent: int) -> None:
        await asyncio.sleep(0.05 * agent)
        await client.delete_agent("room", f"agent_{agent}", force=True)

    uploads = [one(agent) for agent in range(3)]
    removals = [delete(agent) for agent in range(3)]
    for outcome in await asyncio.gather(*uploads, *removals, return_exceptions=True):
        assert outcome is None or isinstance(outcome, NotFound), outcome
    stored = [info.name for info in await client.list_submaps("room")]
    wanted = set().union(*[await digests(client, name) for name in stored]) if stored else set()
    if server.config.store.database:  # servers that share a folder collect from time to time
        await server._upkeep.tidy()
    await eventually(lambda: blobs(server) == wanted)
    assert set((await settled(server, client)).poses) == set(stored)


@pytest.mark.parametrize("bad", ["", "x" * 129, "line\nbreak"])
async def test_a_deletion_needs_a_request_id(bad: str, client: MagicClient, server: Server) -> None:
    await fill(client, submaps=1)
    async with grpc.aio.insecure_channel(server.address) as channel:
        stub = session_grpc.SessionServiceStub(channel)
        request = session_pb.DeleteSessionRequest(name="sessions/room", request_id=bad)
        with pytest.raises(grpc.RpcError) as caught:
            await stub.DeleteSession(request, timeout=60)
    assert isinstance(error_of(caught.value), InvalidInput)
    assert len(await client.list_submaps("room")) == 1


async def test_odometry_joined_over_a_gap_is_as_uncertain_as_both_its_parts() -> None:
    rng = np.random.default_rng(3)
    deviations = [0.02, 0.01, 0.03, 0.004, 0.01, 0.006]
    covariances = [np.diag(np.square(deviations)), np.diag(np.square(deviations[::-1])) * 0.1]
    motions = [se3.exp([0.5, -0.2, 1.0, 0.3, -0.5, 0.2]), se3.exp([-0.4, 0.6, 0.3, -0.1, 0.7, 0.4])]
    first, second = (
        OdometryEdge(i, motion, np.linalg.inv(covariance))
        for i, (motion, covariance) in enumerate(zip(motions, covariances, strict=True))
    )
    edge = joined(first, second)
    assert edge.previous_index == 0
    exact = motions[0] @ motions[1]
    np.testing.assert_allclose(edge.previous_from_anchor, exact, atol=1e-12)
    noise = [rng.multivariate_normal(np.zeros(6), c, size=4_000) for c in covariances]
    samples = np.array(
        [
            se3.log(se3.inverse(exact) @ motions[0] @ se3.exp(a) @ motions[1] @ se3.exp(b))
            for a, b in zip(*noise, strict=True)
        ]
    )
    # 4,000 samples give a covariance within 4 %; the rest is second order.
    expected = np.linalg.inv(edge.information)
    assert np.abs(np.cov(samples.T) - expected).max() < 0.08 * np.abs(expected).max()
