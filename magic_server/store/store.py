"""The store of one server: a database and its blobs, consistent at every instant.

Blobs are written, synced and moved to their places first; one transaction then refers to them. A
server that dies in between leaves blobs that nothing refers to, which the next start removes.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any, Self, TypeVar

import sqlalchemy as sa
from magicslam.v1 import archive_pb2
from sqlalchemy.ext.asyncio import AsyncConnection

from magic_core.errors import ConfigError, WrongState
from magic_server.store import ownership
from magic_server.store.agents import AgentTable
from magic_server.store.archive import ArchiveTable, ImportedSubmap
from magic_server.store.blob_store import BlobObserver, BlobStore, WrittenBlob
from magic_server.store.blobs import BlobFolder, SharedBlobFolder
from magic_server.store.bucket import BucketBlobs, bucket_of
from magic_server.store.commit_lock import CommitLock, SharedCommitLock
from magic_server.store.committing import SubmapCommits
from magic_server.store.database import Database
from magic_server.store.deletions import Deletions
from magic_server.store.descriptors import DescriptorTable, PgvectorPlaces
from magic_server.store.engines import engine_of
from magic_server.store.imports import Imported, ImportRequest
from magic_server.store.leases import LeaseTable
from magic_server.store.loops import LoopTable
from magic_server.store.maps import MapTable, NewMap
from magic_server.store.rows import AgentRow, NewSubmap, SessionRow
from magic_server.store.schema import identity, map_files, submap_blobs
from magic_server.store.submaps import FirstAnswer, SubmapTable
from magic_server.store.uploads import UploadFolder
from magic_server.store.usage import UsageTable
from magic_server.store_config import StoreConfig
from magic_server.upload_config import PartialUploadLimits

logger = logging.getLogger(__name__)
_T = TypeVar("_T")
BUCKET_THREADS = 8
"""Requests to a bucket that the server waits for at a time; each may be for many blobs."""
LOOKED_UP_AT_ONCE = 1000
"""Blobs in memory at a time while those that nothing refers to are looked for."""


class Store:
    """Everything a server remembers, under one folder."""

    def __init__(
        self,
        folder: Path,
        threads: Executor,
        *,
        partial_uploads: PartialUploadLimits | None = None,
        config: StoreConfig | None = None,
        replica: str = "",
        observer: BlobObserver = lambda operation, outcome, seconds: None,
    ) -> None:
        """`replica` names this server among those that share a PostgreSQL database.

        `observer` hears of every request to a bucket.
        """
        place = bucket_of(config or StoreConfig(), folder)
        engine = engine_of(config or StoreConfig(), folder)
        if config is not None and config.index == "pgvector" and not engine.shared:
            raise ConfigError.field(
                "store.index",
                "pgvector needs PostgreSQL; give store.database, or take faiss",
            )
        self.folder = folder
        # What this server alone writes and reads.
        self.scratch = folder / "replicas" / replica if engine.shared else folder
        self.bucket: BucketBlobs | None = None
        self.blobs: BlobStore
        if place is not None:
            server = replica if engine.shared else ""
            self.blobs = self.bucket = BucketBlobs(place, server=server, observer=observer)
        elif engine.shared:
            self.blobs = SharedBlobFolder(folder, self.scratch)
        else:
            self.blobs = BlobFolder(folder)
        self.uploads = UploadFolder(self.scratch)
        # A bucket that is silent holds up whoever asks it, and nobody else.
        self.blob_threads: Executor = threads
        if self.bucket is not None:
            self.blob_threads = ThreadPoolExecutor(BUCKET_THREADS, "magic-bucket")
        self._partial_uploads = partial_uploads or PartialUploadLimits()
        self._database = Database(engine)
        self._commit_lock = SharedCommitLock(self._database) if engine.shared else CommitLock()
        self._lock_files: list[int] = []
        self._identity = ""
        pgvector = config is not None and config.index == "pgvector"
        self._descriptors = DescriptorTable(self._database) if pgvector else None
        # Which sessions this server works on; None where it has all of them.
        self.leases = LeaseTable(self._database, replica) if engine.shared else None
        self._database.fence = self.leases
        self.agents = AgentTable(self._database)
        self.submaps = SubmapTable(self._database, self.blobs)
        self.loops = LoopTable(self._database)
        self.maps = MapTable(self._database)
        self.usage = UsageTable(self._database)
        self.archive = ArchiveTable(self._database)
        self._commits = SubmapCommits(
            self.submaps, self.blobs, lock=self._commit_lock, threads=self.blob_threads
        )
        self.deletions = Deletions(
            self._database, self.blobs, lock=self._commit_lock, threads=self.blob_threads
        )

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def open(self) -> None:
        """Lock the folder, create what is missing and drop what a dead server left half done.

        Raises WrongState when another server has the folder, ConfigError or Unavailable when the
        database does not let this server in.
        """
        self.scratch.mkdir(parents=True, exist_ok=True)
        self._lock_files = [ownership.lock(self.folder, shared=self.leases is not None)]
        if self.leases is None:
            ownership.require_own_database(self.folder)
        else:
            self._lock_files.append(ownership.lock(self.scratch))
        await self._database.open(first=self._require_database)
        if self.bucket is not None:
            await self._in_thread(self.bucket.mark, self._identity)
        if self._descriptors is not None:
            await self._descriptors.open()
        await self._in_thread(self._open_folders)
        # A large bucket takes minutes to go through: there the upkeep does it.
        removed = 0 if self.blobs.far else await self.collect_orphans()
        if removed:
            logger.info("removed %d blobs that nothing referred to", removed)

    async def _require_database(self, connection: AsyncConnection) -> None:
        """Raise WrongState unless blobs and database belong together; while nobody else can."""
        found = await connection.scalar(sa.select(identity.c.id))
        if self.bucket is None and self.leases is None:
            await self._require_folder(connection, found)
            return
        self._identity = found or uuid.uuid4().hex
        if self.bucket is None:
            ownership.require_database(self.folder, self._identity, is_new=found is None)
        else:
            if self.leases is not None:
                ownership.require_no_sqlite(self.folder)
            require, new = self.bucket.require, not await _refers_to_blobs(connection)
            await self._in_thread(lambda: require(self._identity, may_be_new=new))
        if found is None:
            await connection.execute(sa.insert(identity), {"id": self._identity})

    async def _require_folder(self, connection: AsyncConnection, found: str | None) -> None:
        """Raise WrongState where the blobs of a SQLite database are in a bucket."""
        if found is not None and await _refers_to_blobs(connection):
            raise WrongState(
                f"the blobs of {self.folder} are in a bucket; give store.blobs as before, or "
                "choose another data folder"
            )
        await connection.execute(sa.delete(identity))

    def _open_folders(self) -> None:
        self.blobs.open()
        self.uploads.open(self._partial_uploads, now=time.time())

    async def close(self) -> None:
        """Close the database and give the folder free."""
        await self._commits.close()
        await self._database.close()
        if self.bucket is not None:
            await asyncio.to_thread(self.blob_threads.shutdown)
        while self._lock_files:
            os.close(self._lock_files.pop())

    def places(self, session: SessionRow) -> PgvectorPlaces | None:
        """The database's index of a session's descriptors; None where it has none."""
        if self._descriptors is None:
            return None
        return PgvectorPlaces(self._descriptors, self._database, session)

    async def add_submap(
        self, agent: AgentRow, submap: NewSubmap, written: Sequence[WrittenBlob], *, now: float
    ) -> FirstAnswer | None:
        """Make a received sub-map durable: its blobs, then one transaction.

        Returns what was answered before when another request stored the same sub-map meanwhile.
        Nothing is left behind when it fails.
        """
        return await self._commits.add(agent, submap, written, now=now)

    async def add_map(
        self,
        operation: int,
        session: SessionRow,
        made: NewMap,
        *,
        written: Sequence[WrittenBlob],
        now: float,
    ) -> None:
        """Make a merged map durable and its operation done."""
        await self.blobs.bring(written, self.blob_threads)
        async with self._commit_lock:
            fresh = await self._in_thread(self.blobs.adopt, written)
            try:
                await self.maps.succeed(operation, session, made, now=now)
            except BaseException:
                await asyncio.shield(self._in_thread(self.blobs.remove, fresh))
                raise

    async def add_session(
        self,
        archive: archive_pb2.SessionArchive,
        submaps: Sequence[ImportedSubmap],
        asked: ImportRequest,
        *,
        written: Sequence[WrittenBlob],
    ) -> Imported:
        """Make a checked archive durable: all of its session, or nothing."""
        await self.blobs.bring(written, self.blob_threads)
        async with self._commit_lock:
            fresh = await self._in_thread(self.blobs.adopt, written)
            try:
                imported = await self.archive.insert(archive, submaps, asked)
            except BaseException:
                await asyncio.shield(self._in_thread(self.blobs.remove, fresh))
                raise
            if imported.repeated:  # they are those of a session that was deleted since
                await asyncio.shield(self._in_thread(self.blobs.remove, fresh))
            return imported

    async def collect_orphans(self) -> int:
        """Remove blobs that no sub-map and no map refers to; returns how many."""
        # Nobody can add anything meanwhile: a large bucket is gone through part by part.
        return sum([await self._collect(shard) for shard in self.blobs.shards])

    async def _collect(self, shard: str) -> int:
        async with self._commit_lock.alone():
            names, removed = self.blobs.names(shard), 0
            while some := await self._in_thread(lambda: list(islice(names, LOOKED_UP_AT_ONCE))):
                orphans = await self._unused(some)
                await self._in_thread(self.blobs.remove, orphans)
                removed += len(orphans)
            return removed

    async def _unused(self, digests: Sequence[str]) -> list[str]:
        """Those that neither a sub-map nor a map refers to."""
        used: set[str] = set()
        async with self._database.read() as connection:
            for digest in (submap_blobs.c.sha256, map_files.c.sha256):
                used |= set(await connection.scalars(sa.select(digest).where(digest.in_(digests))))
        return [digest for digest in digests if digest not in used]

    async def _in_thread(self, function: Callable[..., _T], *arguments: Any) -> _T:
        return await asyncio.get_running_loop().run_in_executor(
            self.blob_threads, function, *arguments
        )


async def _refers_to_blobs(connection: AsyncConnection) -> bool:
    for table in (submap_blobs, map_files):
        if await connection.scalar(sa.select(table.c.sha256).limit(1)) is not None:
            return True
    return False
