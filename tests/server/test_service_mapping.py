"""Two agents map one room: loops, one component, corrected poses, a merged map, a restart.

One server serves the whole file; the tests look at what two agents left in it.
"""

from __future__ import annotations

import asyncio
import dataclasses
import io
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
import pytest_asyncio

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import AlreadyExists, DescriptorModelMismatch, InvalidInput, NotFound
from magic_core.gaussians.ply import read_ply
from magic_core.geometry import se3
from magic_core.geometry.seams import seams_between
from magic_core.submap import Descriptor
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from tests.postgresql import NewStore
from tests.small_world import DIMENSION, LARGE, MODEL_ID, make_submap, path
from tests.waiting import eventually

pytestmark = pytest.mark.asyncio(loop_scope="module")

SUBMAPS = 3


def submap_of(agent: int, index: int):
    return make_submap(
        agent=agent, index=index, camera=LARGE, frames=4, keyframes=2, submaps=SUBMAPS
    )


def name_of(agent: int, index: int) -> str:
    return f"sessions/room/agents/agent_{agent}/submaps/{index}"


@pytest.fixture(scope="module")
def config(
    tmp_path_factory: pytest.TempPathFactory, new_store: NewStore, jobs: JobConfig
) -> ServerConfig:
    return ServerConfig(
        data_dir=tmp_path_factory.mktemp("mapping"),
        store=new_store(),
        listen=ListenConfig(port=0, stop_grace_s=600.0),
        jobs=dataclasses.replace(jobs, workers=2),
        loops=LoopConfig(top_k=2),
    )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def mapped(config: ServerConfig) -> AsyncIterator[tuple[Server, MagicClient, list]]:
    """A server in which two agents finished, a client, and the solutions a watcher saw."""
    seen: list = []
    async with (
        Server(config) as server,
        MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as client,
    ):
        for agent in range(2):
            await client.register_agent(
                "room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION
            )

        async def watch() -> None:
            async for snapshot in client.watch_corrected_poses("room"):
                seen.append(snapshot)

        watcher = asyncio.create_task(watch())
        for index in range(SUBMAPS):
            await asyncio.gather(*(client.submit_submap(submap_of(a, index)) for a in range(2)))
        coordinator = await server.sessions.named("room")
        assert await coordinator.idle(timeout_s=600)
        yield server, client, seen
        watcher.cancel()


async def test_loops_join_the_agents_in_one_component(mapped) -> None:
    _, client, _ = mapped
    snapshot = await client.get_corrected_poses("room")
    assert len(snapshot.poses) == 2 * SUBMAPS
    (component,) = snapshot.components
    oldest = next(iter(snapshot.poses))
    assert component.id == oldest
    assert set(component.agents) == {f"sessions/room/agents/agent_{a}" for a in range(2)}
    assert {pose.component for pose in snapshot.poses.values()} == {oldest}


async def test_corrected_poses_are_the_true_ones(mapped) -> None:
    _, client, _ = mapped
    snapshot = await client.get_corrected_poses("room")
    truth = {name_of(a, i): path(a, SUBMAPS)[i] for a in range(2) for i in range(SUBMAPS)}
    oldest = next(iter(snapshot.poses))
    for name, pose in snapshot.poses.items():
        expected = se3.inverse(truth[oldest]) @ truth[name]
        error = se3.inverse(expected) @ pose.world_from_anchor
        assert np.linalg.norm(error[:3, 3]) < 0.02, name
        assert np.degrees(se3.rotation_angle(error)) < 1.0, name


async def test_one_agents_poses_can_be_asked_for_alone(mapped) -> None:
    _, client, _ = mapped
    everything = await client.get_corrected_poses("room")
    alone = await client.get_corrected_poses("room", agent="agent_1")
    assert alone.revision == everything.revision
    assert list(alone.poses) == [name for name in everything.poses if "/agent_1/" in name]
    assert alone.components == everything.components


async def test_a_trajectory_is_anchor_times_frame_spread_between_neighbours(mapped) -> None:
    _, client, _ = mapped
    snapshot = await client.get_corrected_poses("room")
    parts = await client.get_trajectory("room", "agent_1")
    assert [part.submap for part in parts] == [name_of(1, i) for i in range(SUBMAPS)]
    anchors = {i: snapshot.poses[part.submap].world_from_anchor for i, part in enumerate(parts)}
    edges = {i: submap_of(1, i).odometry for i in range(1, SUBMAPS)}
    motions = {i: (e.previous_index, e.previous_from_anchor) for i, e in edges.items() if e}
    seams = seams_between(anchors, motions)
    moved_m = 0.0
    for index, part in enumerate(parts):
        corrected = snapshot.poses[part.submap]
        assert (part.revision, part.component) == (snapshot.revision, corrected.component)
        sent = submap_of(1, index).trajectory
        tracked = np.stack([frame.anchor_from_camera for frame in sent])
        rigid = corrected.world_from_anchor @ tracked
        shares = np.arange(len(sent)) / len(sent)
        expected = corrected.world_from_anchor @ seams[index].spread(tracked, shares)
        moved_m = max(moved_m, float(np.abs(expected - rigid)[:, :3, 3].max()))
        for was, pose, frame in zip(sent, expected, part.frames, strict=True):
            assert (frame.frame_index, frame.lost) == (was.frame_index, was.lost)
            np.testing.assert_allclose(frame.world_from_camera, pose, atol=1e-9)
    assert moved_m > 1e-6  # the loops did correct something


async def test_every_candidate_ends_with_a_verdict_and_a_reason(mapped) -> None:
    _, client, _ = mapped
    answer = await client.list_loops("room")
    assert answer.candidates
    for loop in answer.candidates:
        assert loop.verdict in ("ACCEPTED", "REJECTED")
        assert loop.reason.isupper()
        assert loop.verify_seconds > 0
        accepted = loop.verdict == "ACCEPTED"
        assert (loop.reason == "ACCEPTED") == accepted
        assert (loop.target_from_source is not None) == accepted
    accepted = [loop for loop in answer.candidates if loop.verdict == "ACCEPTED"]
    assert any("agent_0" in loop.source + loop.target for loop in accepted)
    for loop in accepted:
        assert loop.information is not None
        assert np.linalg.eigvalsh(loop.information)[0] > 0
        assert 0 < loop.fitness <= 1
        assert loop.rmse_m < 0.05


async def test_accepted_loops_measure_the_true_motion(mapped) -> None:
    _, client, _ = mapped
    truth = {name_of(a, i): path(a, SUBMAPS)[i] for a in range(2) for i in range(SUBMAPS)}
    for loop in (await client.list_loops("room")).candidates:
        if loop.target_from_source is not None and loop.kept:
            expected = se3.inverse(truth[loop.target]) @ truth[loop.source]
            error = se3.inverse(expected) @ loop.target_from_source
            assert np.linalg.norm(error[:3, 3]) < 0.03, loop.source


async def test_a_submap_knows_its_candidates_in_both_roles(mapped) -> None:
    _, client, _ = mapped
    everything = (await client.list_loops("room")).candidates
    name = name_of(0, 0)
    answer = await client.query_loops(name)
    expected = {(c.source, c.target) for c in everything if name in (c.source, c.target)}
    assert {(c.source, c.target) for c in answer.candidates} == expected
    similarities = [c.similarity for c in answer.candidates]
    assert similarities == sorted(similarities, reverse=True)
    assert len((await client.query_loops(name, max_candidates=1)).candidates) == 1


async def test_a_raw_descriptor_finds_its_own_submap_first(mapped) -> None:
    _, client, _ = mapped
    descriptor = submap_of(1, 2).descriptor
    answer = await client.query_loops(descriptor, session="room", max_candidates=3)
    assert answer.candidates[0].target == name_of(1, 2)
    assert answer.candidates[0].similarity == pytest.approx(1.0, abs=1e-5)
    assert (answer.candidates[0].verdict, answer.candidates[0].source) == ("SIMILAR", "")
    assert len(answer.candidates) == 3


async def test_wrong_descriptors_are_refused(mapped) -> None:
    _, client, _ = mapped
    vector = submap_of(0, 0).descriptor.vector
    with pytest.raises(DescriptorModelMismatch):
        await client.query_loops(Descriptor("other", vector), session="room")
    for bad in (vector * 2, vector * np.nan):
        with pytest.raises(InvalidInput):
            await client.query_loops(Descriptor(MODEL_ID, bad), session="room")
    with pytest.raises(InvalidInput):
        await client.query_loops(submap_of(0, 0).descriptor)  # no session


async def test_a_watcher_sees_growing_revisions_up_to_the_newest(mapped) -> None:
    _, client, seen = mapped
    newest = (await client.get_corrected_poses("room")).revision
    await eventually(lambda: seen and seen[-1].revision >= newest)
    revisions = [snapshot.revision for snapshot in seen]
    assert revisions == sorted(set(revisions))
    assert [len(snapshot.poses) for snapshot in seen] == sorted(
        len(snapshot.poses) for snapshot in seen
    )


async def test_a_late_watcher_gets_the_newest_at_once_and_none_twice(mapped) -> None:
    _, client, _ = mapped
    newest = await client.get_corrected_poses("room")
    async for snapshot in client.watch_corrected_poses("room", agent="agent_0"):
        assert snapshot.revision == newest.revision
        assert len(snapshot.poses) == SUBMAPS
        break
    later = client.watch_corrected_poses("room", after_revision=newest.revision)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(anext(later), 0.3)


async def test_a_watch_that_reaches_its_deadline_goes_on_and_repeats_nothing(mapped) -> None:
    server, client, _ = mapped
    newest = (await client.get_corrected_poses("room")).revision
    seen: list[int] = []
    async with MagicClient(server.address, ClientConfig(watch_timeout_s=0.5)) as short:

        async def watch() -> None:
            async for snapshot in short.watch_corrected_poses("room"):
                seen.append(snapshot.revision)

        watcher = asyncio.create_task(watch())
        await eventually(lambda: seen or watcher.done())
        await asyncio.wait([watcher], timeout=1.5)  # two deadlines more, or three
        assert not watcher.done()
        watcher.cancel()
    assert seen == [newest]


async def test_a_global_map_is_built_with_progress_and_read_in_every_format(
    mapped, tmp_path: Path
) -> None:
    _, client, _ = mapped
    steps: list[tuple[float, str]] = []
    info = await client.build_global_map(
        "room",
        coarse_only=True,
        request_id="first map",
        progress=lambda share, stage: steps.append((share, stage)),
    )
    snapshot = await client.get_corrected_poses("room")
    assert (info.component, info.revision) == (snapshot.components[0].id, snapshot.revision)
    assert set(info.submaps) == set(snapshot.poses)
    shares = [share for share, _ in steps]
    assert shares == sorted(shares)
    assert steps[-1] == (1.0, "done")
    cloud = await client.get_global_map(info.name)
    assert len(cloud) == info.gaussian_count > 0
    newest, data = await client.download_global_map("sessions/room", format="ply")
    assert newest == info
    (tmp_path / "map.ply").write_bytes(data)
    np.testing.assert_allclose(read_ply(tmp_path / "map.ply").means, cloud.means, atol=1e-6)
    _, compact = await client.download_global_map(info.name, format="compact")
    assert len(compact) < io.BytesIO(data).getbuffer().nbytes / 3
    repeat = await client.start_global_map("room", coarse_only=True, request_id="first map")
    assert (repeat.done, repeat.result) == (True, info)
    with pytest.raises(AlreadyExists, match="another map"):
        await client.start_global_map("room", request_id="first map")
    assert len(await client.list_operations("room")) == 1


async def test_waiting_for_a_map_outlasts_answers_that_come_too_late(mapped) -> None:
    server, client, _ = mapped
    status = await client.start_global_map("room", coarse_only=True, request_id="first map")
    running = dataclasses.replace(status, state="RUNNING", progress=0.25)
    late = 0

    async with MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as patient:
        in_time = patient.map_stub.WaitOperation

        async def too_late_twice(request, *, timeout: float):  # noqa: ASYNC109 (as gRPC has it)
            nonlocal late
            late += 1
            return await in_time(request, timeout=-1.0 if late < 3 else timeout)

        patient.map_stub.WaitOperation = too_late_twice
        assert await patient.wait_operation(running, timeout_s=600) == status
    assert late == 3


async def test_a_component_that_is_not_there_fails_the_operation(mapped) -> None:
    _, client, _ = mapped
    with pytest.raises(NotFound, match="no component"):
        await client.build_global_map("room", component="sessions/room/agents/x/submaps/0")


async def test_a_server_started_again_knows_everything(mapped, config: ServerConfig) -> None:
    first, client, seen = mapped
    before = await client.get_corrected_poses("room")
    loops = await client.list_loops("room")
    listen = dataclasses.replace(config.listen, port=first.port)
    async with asyncio.timeout(60):  # far less than the grace: watchers are sent away
        await first.stop()
    async with Server(dataclasses.replace(config, listen=listen)) as second:
        coordinator = await second.sessions.named("room")
        assert await coordinator.idle(timeout_s=600)
        after = await client.get_corrected_poses("room")
        assert (after.revision, after.components) == (before.revision, before.components)
        for name, pose in before.poses.items():
            np.testing.assert_array_equal(
                after.poses[name].world_from_anchor, pose.world_from_anchor
            )
        again = await client.list_loops("room")
        assert [(c.source, c.target, c.verdict, c.kept) for c in again.candidates] == [
            (c.source, c.target, c.verdict, c.kept) for c in loops.candidates
        ]
        nearest = await client.query_loops(submap_of(0, 1).descriptor, session="room")
        assert nearest.candidates[0].target == name_of(0, 1)
        assert len(await client.get_global_map("sessions/room")) > 0
        # Mapping goes on where it was: a third agent joins the same component.
        await client.register_agent("room", "agent_2", model_id=MODEL_ID, dimension=DIMENSION)
        late = make_submap(agent=2, index=0, camera=LARGE, frames=4, keyframes=2, submaps=SUBMAPS)
        await client.submit_submap(late)
        (part,) = await client.get_trajectory("room", "agent_2", wait_s=60.0)
        assert (part.submap, len(part.frames)) == (late.name, len(late.trajectory))
        assert await coordinator.idle(timeout_s=600)
        final = await client.get_corrected_poses("room")
        assert final.revision > before.revision
        assert len(final.components) == 1
        assert final.components[0].id == before.components[0].id
        # The watcher of the first server has found its way to the second.
        await eventually(lambda: seen[-1].revision == final.revision)
