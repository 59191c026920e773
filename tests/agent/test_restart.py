"""An agent's restart: what lies in its spool, where it goes on, and what it finds itself in."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from magic_agent import resume
from magic_agent.client import MagicClient
from magic_agent.odometry import Opening
from magic_agent.restart import Restart, find_restart
from magic_agent.resume import ResumePoint, ResumeState
from magic_agent.slam import FrameResult, LocalSlam
from magic_agent.spool import Spool
from magic_agent.tally import Tally
from magic_core.data import Frame
from magic_core.errors import CorruptData, NotFound, WrongState
from magic_core.evaluation import WireBytes
from magic_core.geometry import se3
from magic_core.submap import Submap
from magic_core.wire import decode_submap, encode_submap
from tests.agent.test_local_slam import CAMERA, CONFIG, walk
from tests.small_world import DIMENSION, MODEL_ID, look, make_submap, render, thumbnail

FRAMES = walk(24)


def engine(point: ResumePoint | None = None) -> LocalSlam:
    return LocalSlam(CAMERA, CONFIG, session="s", agent="a", describe=thumbnail, resume=point)


def until_hand_over(slam: LocalSlam, tally: Tally) -> FrameResult:
    """Process frames until one of them ends a sub-map."""
    for frame in FRAMES:
        result = slam.process(frame)
        tally.add_frame(result)
        if result.finished is not None:
            tally.add_submap(result.finished)
            return result
    raise AssertionError("no sub-map was finished")


@pytest.fixture(scope="module")
def handed_over() -> tuple[FrameResult, ResumeState]:
    """The frame that ended sub-map 0, and the state that the agent keeps of it."""
    tally = Tally("a")
    result = until_hand_over(engine(), tally)
    state = ResumeState(
        session="s",
        finished_index=0,
        next_frame=result.frame_index + 1,
        tally=tally.to_json(),
        wire_bytes=(WireBytes(1, 2),),
        opening=result.opening,
    )
    return result, resume.decode(resume.encode(state))


def remembered(result: FrameResult) -> Submap:
    """The finished sub-map as it is read back from the spool."""
    assert result.finished is not None
    encoded = encode_submap(result.finished, request_id="r")
    return decode_submap(encoded.header, encoded.blobs)


def errors(submap: Submap) -> np.ndarray:
    """Distance of each frame's pose from the truth, metres."""
    anchor = FRAMES[submap.trajectory[0].frame_index].world_from_camera
    assert anchor is not None
    found = []
    for tracked in submap.trajectory:
        truth = se3.inverse(anchor) @ FRAMES[tracked.frame_index].world_from_camera
        found.append(np.linalg.norm((truth - tracked.anchor_from_camera)[:3, 3]))
    return np.array(found)


def test_a_state_reads_back_bit_for_bit_and_damage_is_seen(handed_over) -> None:
    result, state = handed_over
    opening, again = result.opening, state.opening
    assert np.array_equal(again.frame.colour, opening.frame.colour)
    assert np.array_equal(again.frame.depth, opening.frame.depth)
    for one, other in zip(again.carried.arrays(), opening.carried.arrays(), strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(again.odometry.information, opening.odometry.information)
    tally = Tally.from_json(state.tally)
    assert tally.to_json() == state.tally
    assert tally.frames == result.frame_index + 1
    data = bytearray(resume.encode(state))
    data[len(data) // 2] ^= 1
    with pytest.raises(CorruptData, match="SHA-256"):
        resume.decode(bytes(data))


def test_a_restarted_engine_goes_on_in_the_sub_map_that_was_begun(handed_over) -> None:
    result, state = handed_over
    slam = engine(ResumePoint(1, state.opening, remembered(result)))
    results = [slam.process(frame) for frame in FRAMES[state.next_frame :]]
    submaps = [r.finished for r in results if r.finished is not None]
    submaps.append(slam.finish())
    assert [submap.index for submap in submaps] == [1, 2]
    indices = [tracked.frame_index for submap in submaps for tracked in submap.trajectory]
    assert indices == list(range(result.frame_index, len(FRAMES)))
    assert submaps[0].odometry.previous_index == 0
    assert not any(r.lost for r in results)
    assert max(errors(submap).max() for submap in submaps) < 0.006


def test_without_its_state_an_engine_finds_itself_in_its_last_sub_map(handed_over) -> None:
    result, _ = handed_over
    slam = engine(ResumePoint(1, None, remembered(result)))
    frame = FRAMES[result.frame_index + 2]
    assert slam.process(frame).submap_index == 1
    submap = slam.finish()
    truth = se3.inverse(FRAMES[0].world_from_camera) @ frame.world_from_camera
    error = se3.log(se3.inverse(truth) @ submap.odometry.previous_from_anchor)
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.degrees(np.linalg.norm(error[3:])) < 0.5
    assert np.linalg.eigvalsh(submap.odometry.information).min() > 0


def test_somewhere_else_an_engine_begins_a_new_chain(handed_over) -> None:
    result, _ = handed_over
    slam = engine(ResumePoint(1, None, remembered(result)))
    away = Frame(30, 1.0, *render(CAMERA, look(1.5, 0.5, 2.6)))
    slam.process(away)
    submap = slam.finish()
    assert (submap.index, submap.odometry) == (1, None)


def test_a_camera_that_moved_on_meanwhile_is_found_in_the_sub_map_before(handed_over) -> None:
    result, state = handed_over
    slam = engine(ResumePoint(1, state.opening, remembered(result)))
    pose = FRAMES[1].world_from_camera @ se3.exp([0.03, 0.02, 0.0, 0.0, 0.0, 0.5])
    found = slam.process(Frame(40, 2.0, *render(CAMERA, pose)))
    assert not found.lost
    anchor = FRAMES[result.frame_index].world_from_camera
    error = np.linalg.norm((se3.inverse(anchor) @ pose - found.anchor_from_camera)[:3, 3])
    assert error < 0.02


def add(spool: Spool, index: int, *, session: str = "room") -> None:
    """Spool a sub-map with the state behind it."""
    submap = make_submap(session, 0, index)
    state = ResumeState(
        session=session,
        finished_index=index,
        next_frame=submap.trajectory[-1].frame_index + 2,
        tally=Tally("agent_0").to_json(),
        wire_bytes=(),
        opening=Opening(Frame(0, 0.0, *render(CAMERA, look(0, 0, 0))), None, None),
    )
    spool.add(index, encode_submap(submap, request_id=submap.name), state=state)


def test_the_newest_sub_map_stays_with_its_state_until_the_next(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    add(spool, 0)
    spool.remove(0)
    assert (spool.pending(), spool.newest()) == ([], 0)
    assert spool.load(0).header.name.endswith("/0")
    spool._write(spool._path(1, "state"), [b"killed before its sub-map was there"])
    again = Spool(tmp_path)
    assert (again.newest(), again.load_state(0).finished_index) == (0, 0)
    add(again, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000001.state", "000001.submap"]
    with pytest.raises(NotFound, match=r"000000\.state"):
        again.load_state(0)
    again.clear()
    assert list(tmp_path.iterdir()) == []


async def restarted(spool: Spool, client: MagicClient, *, session: str = "room") -> Restart:
    registration = await client.register_agent(
        session, "agent_0", model_id=MODEL_ID, dimension=DIMENSION
    )
    with ThreadPoolExecutor(1) as executor:
        return await find_restart(
            spool, client, registration, session=session, agent="agent_0", executor=executor
        )


async def test_where_an_agent_goes_on(client: MagicClient, tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    fresh = await restarted(spool, client)
    assert (fresh.point, fresh.next_frame) == (ResumePoint(0), 0)
    add(spool, 0)
    unsent = await restarted(spool, client)  # it waits in the spool
    assert (unsent.point.next_index, unsent.next_frame) == (1, 5)
    await client.submit_encoded(spool.load(0))
    add(spool, 1)  # the acknowledgement of 0 was lost, 1 was never sent
    again = await restarted(spool, client)
    assert (again.point.next_index, again.next_frame) == (2, 9)
    await client.submit_encoded(spool.load(1))
    for index in (0, 1):
        spool.remove(index)
    behind = await restarted(spool, client)
    assert behind.point.opening is not None
    assert behind.state is not None
    spool._path(1, "state").write_bytes(b"damaged")
    alone = await restarted(spool, client)
    assert (alone.point.opening, alone.point.memory.index, alone.next_frame) == (None, 1, 8)
    spool.clear()  # another machine: the server has it all
    elsewhere = await restarted(spool, client)
    assert (elsewhere.point.next_index, elsewhere.next_frame) == (2, 8)
    assert elsewhere.point.memory.index == 1


async def test_a_spool_that_does_not_fit_the_server(client: MagicClient, tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    add(spool, 1)
    with pytest.raises(WrongState, match=r"sub-maps from 1 on, and .* has 0 on this server"):
        await restarted(spool, client)
    with pytest.raises(WrongState, match="sub-maps of sessions/room/agents/agent_0"):
        await restarted(spool, client, session="hall")
    spool.remove(1)  # sent, to a server that is gone: nothing is lost by starting over
    assert (await restarted(spool, client)).point == ResumePoint(0)
    assert spool.newest() is None
