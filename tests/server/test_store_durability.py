"""The store: blobs are whole or not there, transactions refer to what is on disk."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import hashlib
import os
import uuid
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

import pytest

from magic_core.errors import CorruptData, NotFound, ResourceExhausted, WrongState
from magic_core.submap import Submap
from magic_core.wire import encode_submap
from magic_server.store import Asked, BlobFolder, BlobWriter, NewSubmap, Store, Vertex
from magic_server.store.blobs import translated_disk_errors
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_vertices

NO_DIGESTS = cast("tuple[str, ...]", (None,) * 5)  # what no transaction takes


@pytest.fixture
async def store(tmp_path: Path) -> AsyncIterator[Store]:
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads) as opened:
            yield opened


def written(folder: BlobFolder, data: bytes) -> BlobWriter:
    blob = folder.writer()
    blob.write(data)
    blob.finish()
    return blob


def new_submap(submap: Submap, store: Store) -> tuple[NewSubmap, list[BlobWriter]]:
    encoded = encode_submap(submap, request_id="r")
    blobs = [written(store.blobs, blob) for blob in encoded.blobs]
    digests = tuple(blob.sha256 for blob in blobs)
    return NewSubmap(
        encoded.header, bytes(32), len(submap.gaussians), digests, Vertex.of(encoded.header)
    ), blobs


async def put(store: Store, submap: Submap) -> None:
    """A sub-map of an agent that is there, stored."""
    agent = await store.agents.agent(submap.session, submap.agent)
    made, blobs = new_submap(submap, store)
    await store.add_submap(agent, made, blobs, now=2.0)


async def registered(store: Store, agent: str = "agent_0"):
    asked = Asked(uuid.uuid4().hex, bytes(32), 1.0)
    entered = await store.agents.register(
        "room", agent, model_id=MODEL_ID, dimension=DIMENSION, asked=asked
    )
    return entered.agent


def test_a_blob_is_named_by_its_content_and_checked_when_read(tmp_path: Path) -> None:
    folder = BlobFolder(tmp_path)
    folder.open()
    data = b"some bytes" * 1000
    (name,) = folder.adopt([written(folder, data)])
    assert name == hashlib.sha256(data).hexdigest()
    assert folder.read(name) == data
    assert folder.adopt([written(folder, data)]) == []  # known already
    assert list(folder.incoming.iterdir()) == []
    folder.path(name).write_bytes(data[:-1] + b"x")
    with pytest.raises(CorruptData):
        folder.read(name)
    folder.remove([name])
    with pytest.raises(NotFound):
        folder.read(name)


def test_what_a_dead_server_was_writing_is_dropped_at_the_next_start(tmp_path: Path) -> None:
    folder = BlobFolder(tmp_path)
    folder.open()
    folder.writer().write(b"half a blo")
    folder.open()
    assert list(folder.incoming.iterdir()) == []
    assert list(folder.names()) == []


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_a_limit_and_not_a_crash(number: int) -> None:
    with pytest.raises(ResourceExhausted, match="disk is full"), translated_disk_errors():
        raise OSError(number, os.strerror(number))
    with pytest.raises(PermissionError), translated_disk_errors():
        raise PermissionError(errno.EACCES, "no")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, which Linux has")
def test_a_blob_that_does_not_fit_raises_resource_exhausted(tmp_path: Path) -> None:
    blob = BlobWriter(tmp_path)
    os.dup2(os.open("/dev/full", os.O_WRONLY), blob._file.fileno())
    with pytest.raises(ResourceExhausted):
        blob.write(bytes(1 << 20))
    blob.path.unlink()


async def test_a_submap_is_found_again_by_another_store(tmp_path: Path) -> None:
    submaps = [make_submap(index=i) for i in range(3)]
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads) as store:
            agent = await registered(store)
            for submap in submaps:
                made, blobs = new_submap(submap, store)
                assert await store.add_submap(agent, made, blobs, now=2.0) is None
        async with Store(tmp_path, threads) as store:
            session = await store.agents.session("room")
            vertices = await stored_vertices(store, session)
            assert [vertex.name for vertex in vertices] == [submap.name for submap in submaps]
            assert [v.odometry and v.odometry.previous_index for v in vertices] == [None, 0, 1]
            assert (vertices[1].descriptor.vector == submaps[1].descriptor.vector).all()
            stored = await store.submaps.stored(session, "agent_0", 1)
            encoded = encode_submap(submaps[1], request_id="r")
            assert stored.header == encoded.header.SerializeToString()
            assert [blob.read() for blob in stored.blobs] == list(encoded.blobs)


async def test_blobs_without_a_transaction_are_removed_at_the_next_start(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads) as store:
            agent = await registered(store)
            made, blobs = new_submap(make_submap(), store)
            await store.add_submap(agent, made, blobs, now=2.0)
            kept = set(store.blobs.names())
            _, orphans = new_submap(make_submap(index=1), store)
            store.blobs.adopt(orphans)  # as if the server died before the transaction
            assert set(store.blobs.names()) > kept
        async with Store(tmp_path, threads) as store:
            assert set(store.blobs.names()) == kept


async def test_a_transaction_that_fails_takes_its_blobs_back(store: Store) -> None:
    agent = await registered(store)
    made, blobs = new_submap(make_submap(), store)
    broken = NewSubmap(
        made.header,
        made.header_sha256,
        made.gaussian_count,
        NO_DIGESTS,
        made.vertex,
    )
    with pytest.raises(Exception, match="NOT NULL"):
        await store.add_submap(agent, broken, blobs, now=2.0)
    assert list(store.blobs.names()) == []
    assert await store.submaps.first_answer(agent, 0) is None


async def test_a_blob_that_another_submap_holds_survives_a_failure(store: Store) -> None:
    first, second = await registered(store), await registered(store, "agent_1")
    made, blobs = new_submap(make_submap(), store)
    await store.add_submap(first, made, blobs, now=2.0)
    kept = set(store.blobs.names())
    again, blobs = new_submap(make_submap(), store)
    broken = NewSubmap(
        again.header,
        again.header_sha256,
        0,
        NO_DIGESTS,
        again.vertex,
    )
    with pytest.raises(Exception, match="NOT NULL"):
        await store.add_submap(second, broken, blobs, now=2.0)
    assert set(store.blobs.names()) == kept


async def test_a_commit_is_on_disk_before_it_returns(store: Store) -> None:
    async with store._database.write() as connection:
        assert (await connection.exec_driver_sql("PRAGMA synchronous")).scalar() == 2  # FULL
        assert (await connection.exec_driver_sql("PRAGMA journal_mode")).scalar() == "wal"


async def test_blobs_are_synced_and_named_before_the_transaction(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = await registered(store)
    events: list[str] = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)

        def noted(*given, name=name, real=real):
            events.append(name)
            return real(*given)

        monkeypatch.setattr(os, name, noted)
    insert = store.submaps.insert

    async def inserted(*given, **named):
        events.append("transaction")
        await insert(*given, **named)

    monkeypatch.setattr(store.submaps, "insert", inserted)
    made, blobs = new_submap(make_submap(), store)
    await store.add_submap(agent, made, blobs, now=2.0)
    # Every file, its name, the folders of the names; only then the database.
    folders = {blob.sha256[0] for blob in blobs}
    files = len(blobs)
    expected = ["fsync"] * files + ["replace"] * files + ["fsync"] * len(folders)
    assert events == [*expected, "transaction"]


async def test_submaps_that_wait_together_are_committed_together(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds: list[int] = []
    insert = store.submaps.insert

    async def counted(arrivals):
        rounds.append(len(arrivals))
        await insert(arrivals)

    monkeypatch.setattr(store.submaps, "insert", counted)
    agents = [await registered(store, f"agent_{number}") for number in range(12)]
    ended: list[str] = []

    async def add(number: int) -> None:
        made, blobs = new_submap(make_submap(agent=number), store)
        assert await store.add_submap(agents[number], made, blobs, now=2.0) is None
        ended.append(made.vertex.name)

    await asyncio.gather(*(add(number) for number in range(12)))
    assert sum(rounds) == 12
    assert len(rounds) <= 2  # the first, and all who came meanwhile
    vertices = await stored_vertices(store, agents[0].session)
    assert [vertex.name for vertex in vertices] == ended  # told in the order of the rows


async def test_nobody_fails_for_another_of_the_same_commit(store: Store) -> None:
    agents = [await registered(store, f"agent_{number}") for number in range(3)]
    made = [new_submap(make_submap(agent=number), store) for number in range(3)]
    kept = {blob.sha256 for number in (0, 2) for blob in made[number][1]}
    broken = dataclasses.replace(made[1][0], digests=NO_DIGESTS)
    first, second, third = await asyncio.gather(
        *(
            store.add_submap(agent, submap, blobs, now=2.0)
            for agent, submap, blobs in zip(
                agents, (made[0][0], broken, made[2][0]), (m[1] for m in made), strict=True
            )
        ),
        return_exceptions=True,
    )
    assert first is None
    assert third is None
    assert isinstance(second, Exception)
    vertices = await stored_vertices(store, agents[0].session)
    assert [vertex.name for vertex in vertices] == [made[0][0].vertex.name, made[2][0].vertex.name]
    assert set(store.blobs.names()) == kept  # those of the broken one are taken back


async def test_of_one_submap_by_two_requests_at_once_the_first_is_stored(store: Store) -> None:
    agent = await registered(store)
    twice = [new_submap(make_submap(), store) for _ in range(2)]
    answers = await asyncio.gather(
        *(store.add_submap(agent, made, blobs, now=2.0) for made, blobs in twice)
    )
    assert answers[0] is None
    assert answers[1] is not None
    assert answers[1].request_id == "r"
    assert len(await stored_vertices(store, agent.session)) == 1


async def test_a_damaged_file_is_not_relied_on_and_is_replaced(store: Store) -> None:
    agent, other = await registered(store), await registered(store, "agent_1")
    made, blobs = new_submap(make_submap(), store)
    await store.add_submap(agent, made, blobs, now=2.0)
    path = store.blobs.path(made.digests[0])
    path.write_bytes(path.read_bytes()[:-1])
    again, blobs = new_submap(make_submap(), store)
    await store.add_submap(other, again, blobs, now=3.0)
    assert hashlib.sha256(store.blobs.read(made.digests[0])).hexdigest() == made.digests[0]


async def test_a_folder_has_one_owner(store: Store) -> None:
    with ThreadPoolExecutor(1) as threads, pytest.raises(WrongState, match="another server"):
        await Store(store.folder, threads).open()


async def test_concurrent_writers_take_turns(store: Store) -> None:
    rows = await asyncio.gather(*(registered(store, f"agent_{i}") for i in range(20)))
    assert len({row.id for row in rows}) == 20
    assert len({row.session.id for row in rows}) == 1
