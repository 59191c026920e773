"""Loop candidates and pose graph solutions in the store."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from magic_core.wire import names, records
from magic_server.store.database import Database
from magic_server.store.rows import SessionRow, pack, unpack
from magic_server.store.schema import agents, loops, snapshot_changes, snapshots, submaps

READ_AT_ONCE = 2000
"""Candidates in memory at a time while a session is gone through."""


@dataclass(frozen=True, slots=True)
class StoredSolution:
    """A session's newest solution: serialised PoseSnapshots."""

    whole: bytes | None
    """None before the first."""
    changes: tuple[bytes, ...]
    """Of the revisions since, oldest first: new and changed poses only."""
    settled: bool
    """Whether a solve of the whole graph stands behind it."""


class LoopTable:
    """Loop candidates with their verdicts, and the newest solution of each session."""

    def __init__(self, database: Database) -> None:
        self._database = database

    async def add_candidates(
        self, session: SessionRow, submap: str, candidates: Sequence[records.LoopCandidate]
    ) -> None:
        """Record the candidates of a sub-map, and that they were looked for."""
        _, agent, index = names.parse_submap(submap)
        mine = sa.select(agents.c.id).where(
            agents.c.session_id == session.id, agents.c.name == agent
        )
        searched = sa.update(submaps).where(
            submaps.c.agent_id == mine.scalar_subquery(), submaps.c.number == index
        )
        async with self._database.write(session.id) as connection:
            await connection.execute(searched.values(searched=True))
            if candidates:
                rows = [loop_columns(loop) | {"session_id": session.id} for loop in candidates]
                await connection.execute(sa.insert(loops), rows)

    async def settle(self, session: SessionRow, loop: records.LoopCandidate) -> None:
        """Store what verification found about a candidate."""
        async with self._database.write(session.id) as connection:
            change = sa.update(loops).where(
                loops.c.session_id == session.id,
                loops.c.source == loop.source,
                loops.c.target == loop.target,
            )
            await connection.execute(change.values(loop_columns(loop)))

    async def pages(self, session: SessionRow) -> AsyncIterator[list[records.LoopCandidate]]:
        """Every candidate of a session, oldest first, some at a time."""
        after: int | None = 0
        while after is not None:
            found, after = await self.page(session, after=after, limit=READ_AT_ONCE)
            yield found

    async def page(
        self, session: SessionRow, *, after: int = 0, limit: int = 500
    ) -> tuple[list[records.LoopCandidate], int | None]:
        """Candidates behind row id `after`, and where the next page begins."""
        query = sa.select(loops).where(loops.c.session_id == session.id, loops.c.id > after)
        query = query.order_by(loops.c.id).limit(limit + 1)
        async with self._database.read() as connection:
            rows = (await connection.execute(query)).all()
        following = rows[limit - 1].id if len(rows) > limit else None
        return [loop_record(row) for row in rows[:limit]], following

    async def kept(self, session: SessionRow) -> list[tuple[str, str]]:
        """(source, target) of the loops that the newest solution relies on."""
        query = sa.select(loops.c.source, loops.c.target)
        query = query.where(loops.c.session_id == session.id, loops.c.kept)
        async with self._database.read() as connection:
            return [(row.source, row.target) for row in await connection.execute(query)]

    async def of_submap(self, session: SessionRow, submap: str) -> list[records.LoopCandidate]:
        """The candidates that a sub-map is part of, most similar first."""
        query = sa.select(loops).where(
            loops.c.session_id == session.id,
            sa.or_(loops.c.source == submap, loops.c.target == submap),
        )
        query = query.order_by(loops.c.similarity.desc(), loops.c.id)
        async with self._database.read() as connection:
            return [loop_record(row) for row in await connection.execute(query)]

    async def save_solution(
        self,
        session: SessionRow,
        *,
        revision: int,
        snapshot: bytes,
        kept: Collection[tuple[str, str]],
        settled: bool,
    ) -> None:
        """Replace the session's solution and the changes to it.

        `kept` holds the (source, target) of the loops it relies on; `settled` says whether a solve
        of the whole graph stands behind it.
        """
        row = {"session_id": session.id, "revision": revision, "snapshot": snapshot}
        row["settled"] = settled
        mine = loops.c.session_id == session.id
        async with self._database.write(session.id) as connection:
            await connection.execute(
                sa.delete(snapshots).where(snapshots.c.session_id == session.id)
            )
            await connection.execute(sa.insert(snapshots), row)
            old = sa.delete(snapshot_changes)
            await connection.execute(old.where(snapshot_changes.c.session_id == session.id))
            rows = await connection.execute(
                sa.select(loops.c.id, loops.c.source, loops.c.target, loops.c.kept).where(
                    mine, loops.c.verdict == "ACCEPTED"
                )
            )
            for loop in rows.all():
                wanted = (loop.source, loop.target) in kept
                if wanted != loop.kept:
                    change = sa.update(loops).where(loops.c.id == loop.id).values(kept=wanted)
                    await connection.execute(change)

    async def save_change(
        self,
        session: SessionRow,
        *,
        revision: int,
        change: bytes,
        taken_up: Collection[tuple[str, str]],
        dropped: Collection[tuple[str, str]],
        settled: bool,
    ) -> None:
        """Add a revision on top of the solution: a PoseSnapshot with the changed poses only.

        `taken_up` and `dropped` hold the (source, target) of loops it newly relies on, or no more.
        """
        row = {"session_id": session.id, "revision": revision, "change": change}
        async with self._database.write(session.id) as connection:
            await connection.execute(sa.insert(snapshot_changes), row)
            whole = sa.update(snapshots).where(snapshots.c.session_id == session.id)
            await connection.execute(whole.values(revision=revision, settled=settled))
            for ends, kept in ((taken_up, True), (dropped, False)):
                for source, target in ends:
                    mine = sa.update(loops).where(
                        loops.c.session_id == session.id,
                        loops.c.source == source,
                        loops.c.target == target,
                    )
                    await connection.execute(mine.values(kept=kept))

    async def solution(self, session: SessionRow) -> StoredSolution:
        """The newest solution, as it was stored piece by piece."""
        whole = sa.select(snapshots.c.snapshot, snapshots.c.settled)
        whole = whole.where(snapshots.c.session_id == session.id)
        since = sa.select(snapshot_changes.c.change)
        since = since.where(snapshot_changes.c.session_id == session.id)
        async with self._database.read() as connection:
            stored = (await connection.execute(whole)).one_or_none()
            changes = await connection.scalars(since.order_by(snapshot_changes.c.revision))
            if stored is None:
                return StoredSolution(None, (), settled=True)
            return StoredSolution(stored.snapshot, tuple(changes), settled=stored.settled)


def loop_columns(loop: records.LoopCandidate) -> dict[str, object]:
    """A candidate as the values of its row, the session left out."""
    return {
        "source": loop.source,
        "target": loop.target,
        "similarity": loop.similarity,
        "verdict": loop.verdict,
        "reason": loop.reason,
        "target_from_source": pack(loop.target_from_source),
        "information": pack(loop.information),
        "fitness": loop.fitness,
        "rmse_m": loop.rmse_m,
        "inliers": loop.inliers,
        "overlap": loop.overlap,
        "verify_seconds": loop.verify_seconds,
        "kept": loop.kept,
        "source_keyframe": loop.source_keyframe,
        "target_keyframe": loop.target_keyframe,
    }


def loop_record(row: sa.Row) -> records.LoopCandidate:
    """The candidate of a row."""
    return records.LoopCandidate(
        source=row.source,
        target=row.target,
        similarity=row.similarity,
        verdict=row.verdict,
        reason=row.reason,
        target_from_source=unpack(row.target_from_source, 4),
        information=unpack(row.information, 6),
        fitness=row.fitness,
        rmse_m=row.rmse_m,
        inliers=row.inliers,
        overlap=row.overlap,
        verify_seconds=row.verify_seconds,
        kept=row.kept,
        source_keyframe=row.source_keyframe,
        target_keyframe=row.target_keyframe,
    )
