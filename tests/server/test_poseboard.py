"""The board of poses: changes cost by their size, what was handed out never changes."""

from __future__ import annotations

from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_server.poseboard import PoseBoard
from magic_server.snapshot_changes import merged_bytes

SESSION = "sessions/s"


def name(agent: int, index: int) -> str:
    return f"{SESSION}/agents/a{agent}/submaps/{index}"


def snapshot(revision: int, poses: dict[str, float], **counts: int) -> mapping_pb.PoseSnapshot:
    message = mapping_pb.PoseSnapshot(session=SESSION, revision=revision, **counts)
    for submap, x in poses.items():
        pose = message.poses.add(submap=submap, component=name(0, 0))
        pose.world_from_anchor.x = x
    return message


def places(message: mapping_pb.PoseSnapshot) -> dict[str, float]:
    return {pose.submap: pose.world_from_anchor.x for pose in message.poses}


def test_a_change_moves_what_it_names_adds_what_is_new_and_leaves_the_rest():
    board = PoseBoard(snapshot(1, {name(0, 0): 0.0, name(1, 0): 1.0}))
    before = board.snapshot
    board.apply(snapshot(2, {name(1, 0): 1.5, name(0, 1): 2.0}, loop_count=3))
    expected = {name(0, 0): 0.0, name(1, 0): 1.5, name(0, 1): 2.0}
    assert places(board.snapshot) == expected
    assert (board.revision, board.snapshot.loop_count) == (2, 3)
    assert places(before) == {name(0, 0): 0.0, name(1, 0): 1.0}
    assert before.revision == 1


def test_what_was_handed_out_stays_as_it_was():
    board = PoseBoard(snapshot(1, {name(0, 0): 0.0}))
    handed_out = []
    for revision in range(2, 5):
        board.apply(snapshot(revision, {name(0, 0): float(revision)}))
        handed_out.append((board.snapshot, board.of_agent(f"{SESSION}/agents/a0")))
    for revision, messages in zip(range(2, 5), handed_out, strict=True):
        for message in messages:
            assert (message.revision, places(message)) == (revision, {name(0, 0): float(revision)})


def test_an_agent_sees_its_own_poses_only_with_the_newest_revision():
    board = PoseBoard(snapshot(1, {name(0, 0): 0.0, name(1, 0): 1.0}))
    board.apply(snapshot(2, {name(1, 1): 2.0}))
    own = board.of_agent(f"{SESSION}/agents/a1")
    assert (own.revision, places(own)) == (2, {name(1, 0): 1.0, name(1, 1): 2.0})
    assert places(board.of_agent(f"{SESSION}/agents/a9")) == {}
    assert board.holds({name(1, 1), name(0, 0)})
    assert not board.holds({name(1, 2)})


def test_merging_publishes_nothing_and_equals_applying():
    board = PoseBoard(snapshot(1, {name(0, 0): 0.0}))
    change = snapshot(2, {name(0, 0): 4.0, name(0, 1): 5.0})
    merged = board.merged(change)
    assert board.revision == 1
    board.apply(change)
    assert merged == board.snapshot
    whole = snapshot(1, {name(0, 0): 0.0})
    stored = merged_bytes(whole.SerializeToString(), [change.SerializeToString()])
    assert mapping_pb.PoseSnapshot.FromString(stored) == merged
