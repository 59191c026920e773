"""Revisions of the store's tables: older databases and folders open with all they hold."""

from __future__ import annotations

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from magic_core.errors import (
    CorruptData,
    WrongState,
)
from magic_server.store import Asked, Store, migrations, schema
from tests.postgresql import PostgresServer
from tests.server.test_store_durability import put, registered
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_vertices


def differences(connection: sa.Connection) -> list:
    from alembic.autogenerate import compare_metadata
    from alembic.migration import MigrationContext

    found = compare_metadata(MigrationContext.configure(connection), schema.metadata)
    return [one for one in found if "alembic_version" not in str(one)]


def put_old_session(connection: sa.Connection) -> None:
    """A session, in tables of any age."""
    connection.execute(sa.insert(schema.schema_version), {"version": 1})
    row = {"name": "old", "created_at": 1.0, "model_id": MODEL_ID, "dimension": DIMENSION}
    connection.execute(sa.insert(schema.sessions), row)


def before_the_revisions(connection: sa.Connection) -> None:
    """The tables as builds without revisions made them."""
    new = {"leases", "identity", "imports"}
    tables = [table for table in schema.metadata.sorted_tables if table.name not in new]
    schema.metadata.create_all(connection, tables=tables)
    put_old_session(connection)


async def test_an_older_database_gets_the_tables_that_are_missing(
    postgresql: PostgresServer, tmp_path: Path
) -> None:
    from sqlalchemy.ext.asyncio import create_async_engine

    for address in (postgresql.database(), f"sqlite+aiosqlite:///{tmp_path}/magic.sqlite"):
        pool = create_async_engine(address)
        async with pool.begin() as connection:
            await connection.run_sync(before_the_revisions)
        for _ in range(2):
            async with pool.begin() as connection:
                await migrations.upgrade(connection, "here")
                assert await connection.run_sync(differences) == []
                assert await connection.scalar(sa.select(schema.sessions.c.name)) == "old"
        await pool.dispose()


def revision_3(connection: sa.Connection) -> None:
    """The tables as the build before keyframes had descriptors left them, with a loop."""
    schema.metadata.create_all(connection)
    for table, column in KEYFRAME_COLUMNS:
        connection.execute(sa.text(f"ALTER TABLE {table} DROP COLUMN {column}"))
    connection.execute(sa.text("CREATE TABLE alembic_version (version_num VARCHAR(32))"))
    connection.execute(sa.text("INSERT INTO alembic_version VALUES ('0003')"))
    put_old_session(connection)
    connection.execute(sa.text(OLD_LOOP))


KEYFRAME_COLUMNS = (
    ("submaps", "keyframe_descriptors"),
    ("loops", "source_keyframe"),
    ("loops", "target_keyframe"),
)
OLD_LOOP = (
    "INSERT INTO loops (session_id, source, target, similarity, verdict, reason, fitness, rmse_m, "
    "inliers, overlap, verify_seconds, kept) VALUES "
    "(1, 'a', 'b', 0.5, 'REJECTED', 'LOW_FITNESS', 0, 0, 0, 0, 0, false)"
)


async def test_a_database_from_before_keyframes_had_descriptors_gets_room_for_them(
    postgresql: PostgresServer, tmp_path: Path
) -> None:
    from sqlalchemy.ext.asyncio import create_async_engine

    for address in (postgresql.database(), f"sqlite+aiosqlite:///{tmp_path}/magic.sqlite"):
        pool = create_async_engine(address)
        async with pool.begin() as connection:
            await connection.run_sync(revision_3)
        async with pool.begin() as connection:
            await migrations.upgrade(connection, "here")
            assert await connection.run_sync(differences) == []
            await connection.execute(sa.text(OLD_LOOP.replace("'a', 'b'", "'c', 'd'")))
            found = await connection.execute(sa.select(schema.loops))
            assert [(r.source_keyframe, r.target_keyframe) for r in found] == [(0, 0)] * 2
        await pool.dispose()


async def test_a_folder_from_before_keyframes_had_descriptors_opens_and_takes_them(
    tmp_path: Path,
) -> None:
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads) as store:
            await registered(store)
            await put(store, make_submap(index=0))
        with closing(sqlite3.connect(tmp_path / "magic.sqlite")) as database:
            for table, column in KEYFRAME_COLUMNS:
                database.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
            database.execute("UPDATE alembic_version SET version_num = '0003'")
            database.commit()
        described = make_submap(index=1, keyframes=3, described=True)
        async with Store(tmp_path, threads) as store:
            await put(store, described)
        async with Store(tmp_path, threads) as store:
            old, new = await stored_vertices(store, await store.agents.session("room"))
    assert old.keyframes == ()
    assert [place for place, _ in new.keyframes] == [1, 2]
    for (_, vector), keyframe in zip(new.keyframes, described.keyframes[1:], strict=True):
        np.testing.assert_array_equal(vector, keyframe.descriptor)


async def test_a_folder_from_before_pages_gets_the_indexes_of_a_new_one(tmp_path: Path) -> None:
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
    with ThreadPoolExecutor(1) as threads:
        async with Store(tmp_path, threads) as store:
            await registered(store)
        with closing(sqlite3.connect(tmp_path / "magic.sqlite")) as database:
            new = {*database.execute(query)}
            for table in ("submaps", "loops"):
                database.execute(f"DROP INDEX ix_{table}_arrival")
                database.execute(f"CREATE INDEX ix_{table}_session_id ON {table} (session_id)")
            database.execute("UPDATE alembic_version SET version_num = '0004'")
            database.commit()
        async with Store(tmp_path, threads) as store:
            session = await store.agents.session("room")
            assert await store.agents.active(session) == ["agent_0"]
            async with store._database.write() as connection:
                assert await connection.run_sync(differences) == []
        with closing(sqlite3.connect(tmp_path / "magic.sqlite")) as database:
            assert {*database.execute(query)} == new


async def test_a_new_database_has_every_table_and_a_later_one_is_refused(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as threads:
        async with Store(tmp_path, threads) as store, store._database.write() as connection:
            assert await connection.run_sync(differences) == []
        with closing(sqlite3.connect(tmp_path / "magic.sqlite")) as database:
            database.execute("UPDATE alembic_version SET version_num = '9999'")
            database.commit()
        with pytest.raises(WrongState, match="has schema version 9999"):
            await Store(tmp_path, threads).open()


SINCE_REVISIONS = ("imports", "leases", "identity", "alembic_version")
SINCE_FIRST_BUILDS = ("removed_submaps", "deletions", "answers", "snapshot_changes")


@pytest.mark.parametrize("missing", [SINCE_REVISIONS, SINCE_REVISIONS + SINCE_FIRST_BUILDS])
async def test_an_existing_folder_opens_with_all_it_holds(
    missing: tuple[str, ...], tmp_path: Path
) -> None:
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads) as store:
            await registered(store)
            await put(store, make_submap(index=0))
        with closing(sqlite3.connect(tmp_path / "magic.sqlite")) as database:
            for table in missing:
                database.execute(f"DROP TABLE {table}")
            if "snapshot_changes" in missing:
                database.execute("ALTER TABLE snapshots DROP COLUMN settled")
            database.commit()
        async with Store(tmp_path, threads) as store:
            await put(store, make_submap(index=1))
            session = await store.agents.session("room")
            assert len(await stored_vertices(store, session)) == 2
            asked = Asked("again", bytes(32), 5.0)
            assert await store.agents.finish("room", "agent_0", asked=asked) == 2
            async with store._database.write() as connection:
                assert await connection.run_sync(differences) == []


async def test_tables_that_a_first_build_left_incomplete_are_completed(tmp_path: Path) -> None:
    """Revision 0002 was written down for databases that lacked tables of the first."""
    with ThreadPoolExecutor(1) as threads:
        async with Store(tmp_path, threads) as store:
            await registered(store)
        with closing(sqlite3.connect(tmp_path / "magic.sqlite")) as database:
            for table in (*SINCE_FIRST_BUILDS, "imports"):
                database.execute(f"DROP TABLE {table}")
            database.execute("UPDATE alembic_version SET version_num = '0002'")
            database.commit()
        async with Store(tmp_path, threads) as store, store._database.write() as connection:
            assert await connection.run_sync(differences) == []


@pytest.mark.parametrize("version", ["0001", migrations.HEAD])
async def test_a_database_that_lacks_what_no_build_left_out_is_refused_untouched(
    version: str, tmp_path: Path
) -> None:
    file = tmp_path / "magic.sqlite"
    with ThreadPoolExecutor(1) as threads:
        async with Store(tmp_path, threads):
            pass
        with closing(sqlite3.connect(file)) as database:
            database.execute("DROP TABLE loops")
            database.execute("ALTER TABLE agents DROP COLUMN finished")
            if version == "0001":
                for table in SINCE_REVISIONS:
                    database.execute(f"DROP TABLE {table}")
            database.commit()
            before = list(database.iterdump())
        with pytest.raises(WrongState, match=r"without column agents\.finished, table loops.*back"):
            await Store(tmp_path, threads).open()
        with closing(sqlite3.connect(file)) as database:
            assert list(database.iterdump()) == before


@pytest.mark.parametrize("content", [b"no database at all" * 500, None])
async def test_a_damaged_database_is_named_with_what_helps(
    content: bytes | None, tmp_path: Path
) -> None:
    file = tmp_path / "magic.sqlite"
    with ThreadPoolExecutor(1) as threads:
        async with Store(tmp_path, threads):
            pass
        whole = file.read_bytes()
        # Past the header page, which says that it is a database.
        file.write_bytes(content or whole[:4096] + b"\xff" * (len(whole) - 4096))
        with pytest.raises(CorruptData, match=r"magic\.sqlite is damaged .*from a backup"):
            await Store(tmp_path, threads).open()
