"""Descriptors in PostgreSQL, searched by pgvector.

One table per dimension, `descriptors_{d}`: unit vectors in full precision, of anchors (keyframe 0)
and of keyframes that have one, and an HNSW index of them in half precision. A query takes
candidates of one session from the index and orders them by the exact inner product; a sub-map is
found once, by its best vector. The tables hold nothing that the sub-maps' own rows do not: they may
be dropped while no server runs, and are filled again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import sqlalchemy as sa
from numpy.typing import ArrayLike
from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import ConfigError, InvalidInput
from magic_core.wire import names
from magic_server.places.hits import Hit, Place, best_of_each
from magic_server.store.database import Database
from magic_server.store.rows import SessionRow

LEAST_VERSION = (0, 8)
"""Of pgvector: the first that goes on searching until enough of a session are found."""
MOST_INDEXED = 4000
"""Numbers of a descriptor in half precision that pgvector can index; longer ones are compared with
all of their session."""
MOST_INLINE = 2000
"""Numbers of a descriptor that fit into a row. PostgreSQL keeps longer ones aside, where comparing
with all takes three times as long, which its planner does not know."""
CANDIDATES = 8
"""So many times the neighbours that are asked for are compared exactly."""
LEAST_CANDIDATES = 200
_MOST_CANDIDATES = 1000  # of hnsw.ef_search
_BATCH = 500
_Vector = tuple[str, int, ArrayLike]
"""The name of a sub-map, a place among its keyframes (0: the anchor) and that one's descriptor."""


class DescriptorTable:
    """The descriptors of every session."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def open(self) -> None:
        """See that pgvector is there; ConfigError says what to do otherwise."""
        version = sa.text("SELECT extversion FROM pg_extension WHERE extname = 'vector'")
        async with self._database.read() as connection:
            found = await connection.scalar(version)
        if found is None:
            await self._create_extension()
            async with self._database.read() as connection:
                found = await connection.scalar(version)
        numbers = tuple(int(part) for part in str(found).split(".")[:2])
        if numbers < LEAST_VERSION:
            raise ConfigError.field(
                "store.index",
                f"pgvector {found} is too old, expected 0.8 or later; install a newer one and "
                "run ALTER EXTENSION vector UPDATE, or choose faiss",
            )

    async def prepare(self, dimension: int) -> None:
        """Make the table of a dimension where it is missing."""
        table = _table(dimension)
        statements = [
            f"CREATE TABLE IF NOT EXISTS {table} ("
            "submap_id BIGINT REFERENCES submaps (id) ON DELETE CASCADE, "
            f"session_id BIGINT NOT NULL, embedding vector({dimension}) NOT NULL, "
            "keyframe BIGINT NOT NULL DEFAULT 0, PRIMARY KEY (submap_id, keyframe))",
            f"CREATE INDEX IF NOT EXISTS {table}_session ON {table} (session_id)",
        ]
        if dimension <= MOST_INLINE:
            statements.append(f"ALTER TABLE {table} ALTER COLUMN embedding SET STORAGE PLAIN")
        if dimension <= MOST_INDEXED:
            statements.append(
                f"CREATE INDEX IF NOT EXISTS {table}_hnsw ON {table} "
                f"USING hnsw ((embedding::halfvec({dimension})) halfvec_ip_ops)"
            )
        async with self._database.write() as connection:
            await self._database.engine.lock_schema(connection)
            if await connection.scalar(sa.text(f"SELECT to_regclass('{table}')")) is None:
                for statement in statements:
                    await connection.execute(sa.text(statement))

    async def _create_extension(self) -> None:
        try:
            async with self._database.write() as connection:
                await connection.execute(sa.text("CREATE EXTENSION IF NOT EXISTS vector"))
        except (DBAPIError, ConfigError) as error:
            raise ConfigError.field(
                "store.index",
                "the database has no pgvector; install it on the database server (Debian: "
                "postgresql-NN-pgvector) and run CREATE EXTENSION vector as its superuser, or "
                "choose faiss",
            ) from error


class PgvectorPlaces:
    """The descriptors of one session; see `magic_server.places.Places`."""

    def __init__(self, table: DescriptorTable, database: Database, session: SessionRow) -> None:
        self._tables = table
        self._database = database
        self._session = session
        self._table = _table(session.dimension)

    async def open(self) -> None:
        """Make the table where it is missing."""
        await self._tables.prepare(self._session.dimension)

    async def load(self, places: Sequence[Place]) -> None:
        """Hold these too; what the table has already is left as it is."""
        held_of = await self._held(places)
        missing = [one for one in places if held_of.get(one.name, 0) < 1 + len(one.keyframes)]
        vectors = _vectors_of(missing)
        for begin in range(0, len(vectors), _BATCH):
            async with self._database.write(self._session.id) as connection:
                await self._insert(connection, vectors[begin : begin + _BATCH])

    async def add(self, place: Place) -> None:
        """Hold one more; nothing happens when it is there."""
        async with self._database.write(self._session.id) as connection:
            await self._insert(connection, _vectors_of([place]))

    async def remove(self, names: Collection[str]) -> None:
        """Nothing to do: descriptors go with the rows of their sub-maps."""

    async def nearest(self, vectors: np.ndarray, count: int) -> list[Hit]:
        """The sub-maps nearest to one of the vectors (n, d), each once with its best similarity,
        best first, ties by age."""
        if count < 1:
            return []
        async with self._database.read() as connection:
            await connection.execute(sa.text("SET LOCAL hnsw.iterative_scan = strict_order"))
            found = [
                hit
                for query, vector in enumerate(np.atleast_2d(vectors))
                for hit in await self._of_one(connection, query, vector, count)
            ]
        return best_of_each(found, count)

    async def _held(self, places: Sequence[Place]) -> dict[str, int]:
        """Of some sub-maps, those in the table with the number of their vectors."""
        held = sa.text(
            "SELECT v.agent, v.number, count(*) AS vectors "
            "FROM unnest(CAST(:agents AS text[]), CAST(:numbers AS bigint[])) AS v (agent, number) "
            "JOIN agents a ON a.session_id = :session AND a.name = v.agent "
            "JOIN submaps m ON m.agent_id = a.id AND m.number = v.number "
            f"JOIN {self._table} d ON d.submap_id = m.id GROUP BY v.agent, v.number"
        )
        wanted = [names.parse_submap(place.name)[1:] for place in places]
        values = {"agents": [agent for agent, _ in wanted], "session": self._session.id}
        values |= {"numbers": [number for _, number in wanted]}
        async with self._database.read() as connection:
            rows = await connection.execute(held, values)
            name = self._session.name
            return {names.submap_name(name, r.agent, r.number): r.vectors for r in rows}

    async def _of_one(
        self, connection: AsyncConnection, query: int, vector: np.ndarray, count: int
    ) -> list[Hit]:
        """The `count` sub-maps nearest to a vector."""
        d = self._session.dimension
        half = f"halfvec({d})" if d <= MOST_INDEXED else f"vector({d})"
        # Subqueries: a prepared statement would read the vector's text again for every row.
        statement = sa.text(
            "WITH candidates AS MATERIALIZED ("
            f"SELECT submap_id, keyframe, embedding FROM {self._table} WHERE session_id = :session "
            f"ORDER BY embedding::{half} <#> (SELECT CAST(CAST(:vector AS text) AS {half})) "
            "LIMIT :asked), "
            "exact AS (SELECT submap_id, keyframe, "
            f"-(embedding <#> (SELECT CAST(CAST(:vector AS text) AS vector({d})))) AS similarity "
            "FROM candidates), "
            "best AS (SELECT DISTINCT ON (submap_id) * FROM exact "
            "ORDER BY submap_id, similarity DESC, keyframe) "
            "SELECT a.name, m.number, b.keyframe, b.similarity, "
            "(SELECT count(*) FROM candidates) AS candidates "
            "FROM best b JOIN submaps m ON m.id = b.submap_id JOIN agents a ON a.id = m.agent_id "
            "ORDER BY b.similarity DESC, b.submap_id LIMIT :count"
        )
        values = {"session": self._session.id, "vector": _text(vector, d), "count": count}
        asked = max(count, min(max(count * CANDIDATES, LEAST_CANDIDATES), _MOST_CANDIDATES))
        while True:
            breadth = min(asked, _MOST_CANDIDATES)
            await connection.execute(sa.text(f"SET LOCAL hnsw.ef_search = {breadth}"))
            rows = (await connection.execute(statement, values | {"asked": asked})).all()
            if len(rows) == count or not rows or rows[0].candidates < asked:
                break
            asked *= 4  # many vectors of few sub-maps: look farther
        found = [names.submap_name(self._session.name, row.name, row.number) for row in rows]
        return [
            Hit(name, float(row.similarity), row.keyframe, query)
            for name, row in zip(found, rows, strict=True)
        ]

    async def _insert(self, connection: AsyncConnection, found: Sequence[_Vector]) -> None:
        d = self._session.dimension
        statement = sa.text(
            f"INSERT INTO {self._table} (submap_id, session_id, keyframe, embedding) "
            f"SELECT m.id, m.session_id, v.keyframe, CAST(v.vector AS vector({d})) "
            "FROM unnest(CAST(:agents AS text[]), CAST(:numbers AS bigint[]), "
            "CAST(:keyframes AS bigint[]), CAST(:vectors AS text[])) "
            "AS v (agent, number, keyframe, vector) "
            "JOIN agents a ON a.session_id = :session AND a.name = v.agent "
            "JOIN submaps m ON m.agent_id = a.id AND m.number = v.number "
            "ON CONFLICT DO NOTHING"
        )
        rows = [
            (*names.parse_submap(name)[1:], keyframe, _text(vector, d))
            for name, keyframe, vector in found
        ]
        agents, numbers, keyframes, vectors = map(list, zip(*rows, strict=True))
        values = {"session": self._session.id, "agents": agents, "numbers": numbers}
        values |= {"keyframes": keyframes, "vectors": vectors}
        await connection.execute(statement, values)


def _vectors_of(places: Sequence[Place]) -> list[_Vector]:
    return [
        (place.name, keyframe, vector)
        for place in places
        for keyframe, vector in ((0, place.vector), *place.keyframes)
    ]


def _table(dimension: int) -> str:
    return f"descriptors_{int(dimension)}"


def _text(vector: ArrayLike, dimension: int) -> str:
    """A unit vector as pgvector reads it."""
    row = np.asarray(vector, dtype=np.float32).reshape(-1)
    norm = float(np.linalg.norm(row))
    if len(row) != dimension:
        raise InvalidInput.field("vector", f"{len(row)} numbers, expected {dimension}")
    if not np.isfinite(norm) or norm == 0.0:
        raise InvalidInput.field("vector", f"norm {norm}: expected a finite, non-zero vector")
    return "[" + ",".join(map(repr, (row / np.float32(norm)).tolist())) + "]"
