"""Reads an archive as it comes in, piece by piece, and believes nothing that it says of itself."""

from __future__ import annotations

import hashlib
from collections.abc import Generator

from google.protobuf.message import DecodeError
from magicslam.v1 import archive_pb2

from magic_core.errors import CorruptData, InvalidInput
from magic_server.archive import layout
from magic_server.archive.layout import BLOCK, Member
from magic_server.store import BlobStore, WrittenBlob


class ArchiveReader:
    """Takes the bytes of one archive. Every method blocks.

    Blobs go to where the store has what is on its way in; `discard` removes what was not adopted.
    """

    def __init__(self, store: BlobStore, *, max_bytes: int | None = None) -> None:
        self.archive = archive_pb2.SessionArchive()
        self.blobs: dict[str, WrittenBlob] = {}
        self.manifest_sha256 = b""
        """Of the manifest, which holds the digests of all other files."""
        self.knows_session = False
        """Whether `archive` is read; what it says is not checked yet."""
        self._store = store
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._script = self._read()
        self._wanted = next(self._script)
        self._done = False

    def feed(self, data: bytes) -> None:
        """Take the next bytes; raises CorruptData or InvalidInput as soon as they are wrong."""
        self._buffer += data
        while not self._done and len(self._buffer) >= self._wanted:
            piece = bytes(self._buffer[: self._wanted])
            del self._buffer[: self._wanted]
            try:
                self._wanted = self._script.send(piece)
            except StopIteration:
                self._done = True
        if self._done and self._buffer.strip(b"\0"):
            raise CorruptData("the archive goes on behind its end")
        if self._done:
            self._buffer.clear()  # tar writers may fill up their last record

    def finish(self) -> None:
        """No more bytes come; raises CorruptData when some are missing."""
        if not self._done:
            raise CorruptData("the archive ends early; transfer it again")

    def discard(self) -> None:
        """Remove every blob that was not adopted."""
        for blob in self.blobs.values():
            blob.discard()

    def _read(self) -> Generator[int, bytes, None]:
        """The archive from front to end: yields how many bytes it wants next."""
        length = layout.announced_manifest((yield BLOCK))
        manifest = yield length
        self.manifest_sha256 = hashlib.sha256(manifest).digest()
        members = layout.members_of(manifest)
        yield layout.padding(length)
        self._check_size(members)
        session, *blobs = members
        layout.check_tar_header((yield BLOCK), session.path, session.length)
        self._parse(session, (yield session.length))
        yield layout.padding(session.length)
        for member in blobs:
            layout.check_tar_header((yield BLOCK), member.path, member.length)
            yield from self._blob(member)
            yield layout.padding(member.length)
        if (yield len(layout.END)) != layout.END:
            raise CorruptData("the archive goes on behind the files of its manifest")

    def _check_size(self, members: list[Member]) -> None:
        total = sum(member.length for member in members)
        if self._max_bytes is not None and total > self._max_bytes:
            raise InvalidInput.field(
                layout.MANIFEST, f"the archive holds {total} bytes, at most {self._max_bytes}"
            )

    def _parse(self, member: Member, data: bytes) -> None:
        if hashlib.sha256(data).hexdigest() != member.sha256:
            raise CorruptData(f"{member.path} does not match its SHA-256; transfer it again")
        try:
            self.archive.ParseFromString(data)
        except DecodeError as error:
            raise CorruptData(f"{member.path} is not a SessionArchive message") from error
        self.knows_session = True

    def _blob(self, member: Member) -> Generator[int, bytes, None]:
        blob = self.blobs[member.sha256] = self._store.writer()
        while left := member.length - blob.length:
            blob.write((yield min(left, 1 << 20)))
        if blob.sha256 != member.sha256:
            raise CorruptData(f"{member.path} does not match its SHA-256; transfer it again")
        blob.finish()
