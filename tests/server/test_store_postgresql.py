"""PostgreSQL as the store's database: who is let in, what is said, and whose writes count."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
import sqlalchemy as sa

from magic_core.errors import (
    ConfigError,
    HeldElsewhere,
    NotFound,
    Unavailable,
    WrongState,
)
from magic_server.store import Store, schema
from magic_server.store_config import StoreConfig
from tests.postgresql import PASSWORD, USER, PostgresServer
from tests.server.test_store_durability import new_submap, put, registered
from tests.small_world import make_submap
from tests.stored import stored_vertices

OpenStore = Callable[..., "asyncio.Future[Store]"]


@pytest.fixture
async def opened(postgresql: PostgresServer, tmp_path: Path) -> AsyncIterator[OpenStore]:
    """Opens stores of one database and one folder, by the names of their servers."""
    address = postgresql.database()
    with ThreadPoolExecutor(2) as threads:
        async with AsyncExitStack() as stack:

            async def one(replica: str, folder: Path = tmp_path, database: str = address) -> Store:
                config = StoreConfig(database=database)
                store = Store(folder, threads, config=config, replica=replica)
                stack.push_async_exit(store)
                await store.open()
                assert store.leases is not None
                store.leases.begin(address=f"{replica}:1", lease_s=600.0)
                return store

            yield one


async def expire(store: Store) -> None:
    """As if the holder had not been heard of for long."""
    async with store._database.write() as connection:
        await connection.execute(sa.update(schema.leases).values(expires_at=1.0))


async def test_a_lease_that_was_lost_refuses_writes_within_the_transaction(
    opened: OpenStore,
) -> None:
    first, second = await opened("first"), await opened("second")
    await registered(first)
    await put(first, make_submap(index=0))
    session = await first.agents.session("room")
    with pytest.raises(HeldElsewhere) as refused:
        await second.leases.take(session)
    assert refused.value.holder == "first:1"
    with pytest.raises(HeldElsewhere):
        await registered(second, "agent_1")
    await expire(second)
    await second.leases.take(session)
    # The first server knows nothing of it.
    with pytest.raises(HeldElsewhere) as refused:
        await put(first, make_submap(index=1))
    assert refused.value.holder == "second:1"
    with pytest.raises(HeldElsewhere):
        await first.loops.save_solution(session, revision=9, snapshot=b"", kept=set(), settled=True)
    await put(second, make_submap(index=1))
    assert len(await stored_vertices(first, session)) == 2
    assert (await first.loops.solution(session)).whole is None
    assert await first.leases.renew() == (set(), {session.id})


async def test_a_transaction_under_way_ends_before_its_session_moves(opened: OpenStore) -> None:
    first, second = await opened("first"), await opened("second")
    await registered(first)
    session = await first.agents.session("room")
    await expire(first)
    async with first._database.write(session.id):
        taking = asyncio.ensure_future(second.leases.take(session))
        await asyncio.sleep(0.2)
        assert not taking.done()
    await taking
    with pytest.raises(HeldElsewhere):
        async with first._database.write(session.id):
            pass


async def test_a_server_started_again_takes_its_own_sessions_back_at_once(
    opened: OpenStore,
) -> None:
    first = await opened("first")
    await registered(first)
    with pytest.raises(WrongState, match="another server"):
        await opened("first")
    await first.close()  # without a word to the others, as if it had been killed
    second = await opened("second")
    assert await second.leases.free(10) == []
    again = await opened("first")
    (session,) = await again.leases.free(10)
    await again.leases.take(session)
    await registered(again, "agent_1")


async def test_a_lease_that_is_released_is_free_at_once(opened: OpenStore) -> None:
    first, second = await opened("first"), await opened("second")
    await registered(first)
    await first.leases.release()
    (session,) = await second.leases.free(10)
    await second.leases.take(session)
    with pytest.raises(HeldElsewhere):
        await registered(first, "agent_1")


async def test_agents_that_begin_a_session_at_once_enter_the_same(opened: OpenStore) -> None:
    first, second = await opened("first"), await opened("second")
    outcomes = await asyncio.gather(
        *(registered(store, f"agent_{i}") for i in range(10) for store in (first, second)),
        return_exceptions=True,
    )
    entered = [one for one in outcomes if not isinstance(one, BaseException)]
    assert len(entered) == 10
    assert len({agent.session.id for agent in entered}) == 1
    assert all(isinstance(o, HeldElsewhere) for o in outcomes if isinstance(o, BaseException))


async def test_a_deleted_session_takes_its_lease_along(opened: OpenStore) -> None:
    from magic_server.store import DeletionRequest

    store = await opened("first")
    agent = await registered(store)
    await store.deletions.session(agent.session, DeletionRequest("sessions/room", "r", 3.0))
    with pytest.raises(NotFound, match="deleted"):
        await store.leases.take(agent.session)
    assert (await registered(store)).session.id > agent.session.id


async def test_blobs_stay_while_another_server_comes_to_rely_on_them(opened: OpenStore) -> None:
    first, second = await opened("first"), await opened("second")
    await registered(first)
    async with second._commit_lock:  # between adopting blobs and the transaction
        await put(first, make_submap(index=0))  # servers that add do not wait for each other
        kept = set(first.blobs.names())
        _, blobs = new_submap(make_submap(index=1), second)
        second.blobs.adopt(blobs)
        collecting = asyncio.ensure_future(first.collect_orphans())
        await asyncio.sleep(0.2)
        assert not collecting.done()
    assert await collecting == len({blob.sha256 for blob in blobs} - kept)
    assert set(first.blobs.names()) == kept


async def test_totals_are_whole_numbers_and_ids_beyond_32_bits_are_asked_for(
    opened: OpenStore,
) -> None:
    store = await opened("first")
    agent = await registered(store)
    await put(store, make_submap(index=0))
    usage = await store.usage.of_agent(agent)
    assert (usage.submaps, type(usage.bytes)) == (1, int)
    (info,), _ = await store.agents.agent_page(agent.session)
    assert info.next_submap_index == 1
    with pytest.raises(NotFound):
        await store.maps.operation("room", str(10**16))


async def test_a_folder_belongs_to_one_database(
    opened: OpenStore, postgresql: PostgresServer, tmp_path: Path
) -> None:
    await opened("first")
    with pytest.raises(WrongState, match="not the data folder of this database"):
        await opened("second", folder=tmp_path / "other")
    with pytest.raises(WrongState, match="not the data folder of this database"):
        await opened("third", database=postgresql.database())
    with ThreadPoolExecutor(1) as threads:
        with pytest.raises(WrongState, match="in use by another server"):
            await Store(tmp_path, threads).open()
        async with Store(tmp_path / "sqlite", threads):
            pass
        with pytest.raises(WrongState, match="sessions export"):
            await opened("fourth", folder=tmp_path / "sqlite", database=postgresql.database())


async def test_a_folder_of_postgresql_is_not_tidied_by_sqlite(
    opened: OpenStore, tmp_path: Path
) -> None:
    store = await opened("first")
    await registered(store)
    await put(store, make_submap(index=0))
    kept = set(store.blobs.names())
    await store.close()
    with ThreadPoolExecutor(1) as threads, pytest.raises(WrongState, match=r"give store\.database"):
        await Store(tmp_path, threads).open()
    assert set(store.blobs.names()) == kept


async def test_a_database_that_is_away_is_unavailable_and_comes_back(
    opened: OpenStore, postgresql: PostgresServer
) -> None:
    store = await opened("first")
    await registered(store)
    postgresql.stop()
    try:
        with pytest.raises(Unavailable, match="is away") as away:
            await registered(store, "agent_1")
        assert away.value.retry_after_s is not None
        assert PASSWORD not in str(away.value)
    finally:
        postgresql.start()
    await registered(store, "agent_1")
    assert len(await store.agents.active(await store.agents.session("room"))) == 2


# What an operator reads


async def test_every_wrong_address_says_what_to_do_and_no_password(
    postgresql: PostgresServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    good = postgresql.database()
    postgresql.sql("CREATE ROLE guest LOGIN PASSWORD 'guest-secret'")
    name = good.rpartition("/")[2]
    cases = {
        good.replace(PASSWORD, "wrong-secret"): (ConfigError, f"password of {USER}"),
        good.replace(name, "nowhere"): (ConfigError, "createdb --owner=magic nowhere"),
        good.replace(f"{USER}:{PASSWORD}", "guest:guest-secret"): (ConfigError, "OWNER TO guest"),
        good.replace(f":{postgresql.port}/", ":1/"): (Unavailable, "is it running"),
        good.replace("127.0.0.1", "no-such-host.invalid"): (Unavailable, "is it running"),
    }
    with ThreadPoolExecutor(1) as threads:
        for number, (address, (kind, remedy)) in enumerate(cases.items()):
            config = StoreConfig(database=address)
            store = Store(tmp_path / str(number), threads, config=config, replica="one")
            try:
                with pytest.raises(kind, match=remedy) as said:
                    await store.open()
            finally:
                await store.close()
            assert "secret" not in f"{said.value} {config}"
    assert "secret" not in caplog.text
    assert PASSWORD not in caplog.text


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("mysql://magic:secret@host/magic", "mysql: expected postgresql"),
        ("postgresql+asyncpg://magic:secret@host", "names no database"),
        ("not an address, secret", "not the address of a database"),
        ("postgresql://magic:secret@host:port/magic", "not the address of a database"),
    ],
)
def test_an_address_that_is_none_is_refused(address: str, said: str, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as threads, pytest.raises(ConfigError, match=said) as refused:
        Store(tmp_path, threads, config=StoreConfig(database=address))
    assert "secret" not in str(refused.value)


def test_the_driver_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "asyncpg", None)
    with ThreadPoolExecutor(1) as threads, pytest.raises(ConfigError, match=r"magic-slam\[cluster"):
        Store(tmp_path, threads, config=StoreConfig(database="postgresql://magic@host/magic"))


def test_the_address_comes_from_an_option_a_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAGIC_DATABASE", "postgresql://from/environment")
    file = tmp_path / "address"
    file.write_text("postgresql://from/file\n")
    assert StoreConfig(database="given", database_file=file).address() == "given"
    assert StoreConfig(database_file=file).address() == "postgresql://from/file"
    assert StoreConfig().address() == "postgresql://from/environment"
    assert StoreConfig(database_env="UNSET").address() == ""
    file.write_text("\n")
    with pytest.raises(ConfigError, match="expected one line"):
        StoreConfig(database_file=file).address()
    with pytest.raises(ConfigError, match="cannot be read"):
        StoreConfig(database_file=tmp_path / "missing").address()
