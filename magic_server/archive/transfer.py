"""Sessions out of a store and into one, as the bytes of an archive."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from concurrent.futures import Executor
from typing import Any, TypeVar

from magic_core.errors import CorruptData, ResourceExhausted
from magic_core.wire import SubmapLimits, names, records
from magic_core.wire.chunks import sha256
from magic_server.archive import layout
from magic_server.archive.checking import check_archive
from magic_server.archive.layout import Member
from magic_server.archive.reader import ArchiveReader
from magic_server.store import ImportedSubmap, ImportRequest, Store, archive_of

PIECE_BYTES = 1 << 20
_T = TypeVar("_T")


async def _whole(work: Coroutine[Any, Any, _T]) -> _T:
    """Run to the end: whoever is cancelled meanwhile waits for it first."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)
        raise


class Archives:
    """Exports and imports whole sessions of a store."""

    def __init__(self, store: Store, *, threads: Executor, limits: SubmapLimits) -> None:
        self._store = store
        self._threads = threads
        self._limits = limits

    async def export(self, session: str) -> AsyncIterator[bytes]:
        """The archive of a session, by its id, in pieces of at most a megabyte.

        Raises NotFound without it, and when something of it is deleted meanwhile, CorruptData when
        a blob is not what it was.
        """
        rows = await self._store.archive.rows(session)
        archive, lengths = await self._in_thread(archive_of, rows)
        data = await self._in_thread(archive.SerializeToString)
        blobs = [Member(layout.blob_path(key), length, key) for key, length in lengths.items()]
        members = [Member(layout.SESSION, len(data), sha256(data).hex()), *blobs]
        if len(data) > layout.MAX_SESSION_BYTES:
            raise ResourceExhausted(f"sessions/{session} is too large for one archive")
        manifest = layout.manifest_of(
            members, session=names.session_name(session), submaps=len(rows.submaps)
        )
        small = layout.tar_header(layout.MANIFEST, len(manifest)) + manifest
        small += bytes(layout.padding(len(manifest)))
        small += layout.tar_header(layout.SESSION, len(data)) + data
        small += bytes(layout.padding(len(data)))
        for begin in range(0, len(small), PIECE_BYTES):
            yield small[begin : begin + PIECE_BYTES]
        for member in blobs:
            yield layout.tar_header(member.path, member.length)
            async for piece in self._pieces(member):
                yield piece
            yield bytes(layout.padding(member.length))
        yield layout.END

    async def import_(
        self,
        pieces: AsyncIterable[bytes],
        *,
        request_id: str,
        max_bytes: int | None = None,
        on_stored: Callable[[str], Awaitable[object]] | None = None,
    ) -> records.SessionInfo:
        """Store the session of an archive; a repeat of the request gets the first answer.

        `on_stored` is awaited with the session's id once it is durable, also when the caller is
        gone by then. Raises AlreadyExists when there is a session of its name or the id was used
        for another archive, CorruptData or InvalidInput for an archive that breaks a rule. Nothing
        is stored then.
        """
        reader = ArchiveReader(self._store.blobs, max_bytes=max_bytes)
        asked = None
        try:
            async for piece in pieces:
                await self._in_thread(reader.feed, piece)
                if asked is None and reader.knows_session:
                    asked = _asked(reader, request_id)
                    if (first := await self._store.archive.first_answer(asked)) is not None:
                        return first.session
            reader.finish()
            submaps = await self._in_thread(
                check_archive, reader.archive, reader.blobs, self._limits
            )
            assert asked is not None  # `finish` passes only behind the session
            return await _whole(self._add(reader, submaps, asked, on_stored))
        finally:
            await asyncio.shield(self._in_thread(reader.discard))

    async def _add(
        self,
        reader: ArchiveReader,
        submaps: Sequence[ImportedSubmap],
        asked: ImportRequest,
        on_stored: Callable[[str], Awaitable[object]] | None,
    ) -> records.SessionInfo:
        written = list(reader.blobs.values())
        added = await self._store.add_session(reader.archive, submaps, asked, written=written)
        if on_stored is not None and not added.repeated:
            await on_stored(names.parse_session(asked.name))
        return added.session

    async def _pieces(self, member: Member) -> AsyncIterator[bytes]:
        offset, digest = 0, hashlib.sha256()
        while offset < member.length:
            length = min(PIECE_BYTES, member.length - offset)
            piece = await self._in_thread(
                self._store.blobs.read_piece, member.sha256, offset, length
            )
            if not piece:
                raise CorruptData(f"blob {member.sha256} is shorter than it was")
            await self._in_thread(digest.update, piece)
            offset += len(piece)
            if offset == member.length and digest.hexdigest() != member.sha256:
                raise CorruptData(self._store.blobs.damage(member.sha256))
            yield piece

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _asked(reader: ArchiveReader, request_id: str) -> ImportRequest:
    name = reader.archive.session.name
    names.parse_session(name, field="session.name")
    return ImportRequest(name, request_id, reader.manifest_sha256, time.time())
