"""A session is taken up page by page, however many sub-maps, loops and blobs it has."""

from __future__ import annotations

import dataclasses
from collections.abc import AsyncIterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from magic_agent.client import ClientConfig, MagicClient
from magic_core.wire import records
from magic_server.config import ServerConfig
from magic_server.loops import LoopConfig
from magic_server.places import LocalPlaces, Place
from magic_server.server import Server
from magic_server.store import AgentRow, Store, loops, store, submaps
from magic_server.store.descriptors import PgvectorPlaces
from tests.postgresql import NewStore
from tests.server.test_store_durability import new_submap, registered
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import put_stray, stored_vertices
from tests.waiting import eventually

AT_ONCE = 4
COUNT = 10


@pytest.fixture(autouse=True)
def small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in (
        (submaps, "READ_AT_ONCE"), (loops, "READ_AT_ONCE"), (store, "LOOKED_UP_AT_ONCE"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, AT_ONCE)


@pytest.fixture
async def opened(new_store: NewStore, tmp_path: Path) -> AsyncIterator[Store]:
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads, config=new_store(), replica="one") as found:
            if found.leases is not None:
                found.leases.begin(address="here:1", lease_s=600.0)
            yield found


async def with_submaps(opened: Store) -> AgentRow:
    """An agent that has stored COUNT sub-maps."""
    agent = await registered(opened)
    for index in range(COUNT):
        await add(opened, agent, index)
    return agent


async def add(opened: Store, agent: AgentRow, index: int) -> None:
    made, blobs = new_submap(make_submap(index=index, submaps=COUNT + 1), opened)
    assert await opened.add_submap(agent, made, blobs, now=2.0) is None


async def test_submaps_are_read_when_their_page_is_asked_for(opened: Store) -> None:
    agent = await with_submaps(opened)
    sizes, numbers = [], []
    async for page in opened.submaps.pages(agent.session):
        if not sizes:
            await add(opened, agent, COUNT)  # so nothing behind the first page was read
        sizes.append(len(page))
        numbers += [vertex.index for vertex in page]
    assert sizes == [AT_ONCE, AT_ONCE, COUNT + 1 - 2 * AT_ONCE]
    assert numbers == list(range(COUNT + 1))


async def test_loops_are_read_when_their_page_is_asked_for(opened: Store) -> None:
    agent = await with_submaps(opened)
    names = [vertex.name for vertex in await stored_vertices(opened, agent.session)]

    async def found(number: int) -> None:
        pair = records.LoopCandidate(names[0], names[number], 0.9, "PENDING", "PENDING")
        await opened.loops.add_candidates(agent.session, names[0], [pair])

    for number in range(1, COUNT - 1):
        await found(number)
    sizes, targets = [], []
    async for page in opened.loops.pages(agent.session):
        if not sizes:
            await found(COUNT - 1)
        sizes.append(len(page))
        targets += [loop.target for loop in page]
    assert sizes == [AT_ONCE, AT_ONCE, COUNT - 1 - 2 * AT_ONCE]
    assert targets == names[1:]


async def test_blobs_are_looked_up_some_at_a_time(
    opened: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    await with_submaps(opened)
    kept = set(opened.blobs.names())
    assert len(kept) > 2 * AT_ONCE
    strays = {f"{digit:x}" * 64 for digit in range(16)}
    for stray in strays:
        put_stray(opened.blobs, stray, b"nobody refers to it")
    asked: list[int] = []
    unused = Store._unused

    async def counted(self: Store, digests: Sequence[str]) -> list[str]:
        asked.append(len(digests))
        return await unused(self, digests)

    monkeypatch.setattr(Store, "_unused", counted)
    assert await opened.collect_orphans() == len(strays)
    assert set(opened.blobs.names()) == kept
    assert max(asked) <= AT_ONCE
    assert sum(asked) == len(kept | strays)


async def test_a_server_that_starts_again_loads_its_index_page_by_page(
    server_config: ServerConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    # None is alike enough to be verified, which takes long.
    server_config = dataclasses.replace(server_config, loops=LoopConfig(min_similarity=1.0))
    loaded: list[int] = []
    for kind in (LocalPlaces, PgvectorPlaces):
        monkeypatch.setattr(kind, "load", counting(kind.load, loaded))
    sent = [make_submap(index=index, submaps=COUNT) for index in range(COUNT)]
    async with Server(server_config) as server, connected(server) as client:
        await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        for submap in sent:
            await client.submit_submap(submap)
        coordinator = await server.sessions.named("room")
        await eventually(lambda: not coordinator.busy)  # all are searched
    loaded.clear()
    async with Server(server_config) as server, connected(server) as client:
        await eventually(lambda: server.sessions.found("room"))
        assert sum(loaded) == COUNT
        assert max(loaded) <= AT_ONCE
        coordinator = await server.sessions.named("room")
        for submap in sent:
            vector = submap.descriptor.vector
            (best,) = await coordinator.nearest(vector, count=1, min_similarity=0.5)
            assert best.target == submap.name
        poses = (await client.get_corrected_poses("room")).poses
        assert set(poses) == {submap.name for submap in sent}


def connected(server: Server) -> MagicClient:
    return MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0))


def counting(load, sizes: list[int]):
    """The same method, which notes how many places it is given."""

    async def counted(self, places: Sequence[Place]) -> None:
        sizes.append(len(places))
        await load(self, places)

    return counted
