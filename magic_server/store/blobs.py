"""The blob folder: content-addressed files, whole and on disk before anything refers to them.

    blobs/{first hex digit}/{sha256 in hex}   complete, never changed
    incoming/                                 maps being written; emptied at every start

Every method blocks: call them on a thread.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from magic_core.errors import CorruptData, DiskFull, NotFound
from magic_server.store.blob_store import WrittenBlob

_READ_BYTES = 1 << 20
SYNCS_AT_ONCE = 8
DISK_RETRY_S = 15.0
"""How long callers are asked to wait when the disk is full."""


@dataclass(frozen=True, slots=True)
class FileBlob:
    """A blob in a file."""

    path: Path

    def read(self) -> bytes:
        """All of it, checked. NotFound without it, CorruptData when it is not what it was."""
        return read_checked(self.path)

    def head(self, length: int) -> bytes:
        """Its first bytes, unchecked."""
        with self.path.open("rb") as file:
            return file.read(length)


@dataclass(frozen=True, slots=True)
class LocalFile:
    """A file that is read in pieces."""

    path: Path
    sha256: str

    def pieces(self) -> Iterator[bytes]:
        """All of it in order. NotFound without it, CorruptData when it is not what it was."""
        digest = hashlib.sha256()
        try:
            with self.path.open("rb") as file:
                while piece := file.read(_READ_BYTES):
                    digest.update(piece)
                    yield piece
        except FileNotFoundError:
            raise NotFound("what is being read has been deleted") from None
        if digest.hexdigest() != self.sha256:
            raise CorruptData(damage(self.path))


class BlobFolder:
    """Files named by the SHA-256 of their content."""

    far = False
    shards: Sequence[str] = ("",)

    def __init__(self, root: Path, scratch: Path | None = None) -> None:
        """`scratch`: a folder on the same disk for what is being written, else the same one."""
        self.blobs = root / "blobs"
        self.incoming = (scratch or root) / "incoming"

    def open(self) -> None:
        """Create the folders and drop what a dead server was writing."""
        for folder in (self.incoming, *(self.blobs / digit for digit in "0123456789abcdef")):
            folder.mkdir(parents=True, exist_ok=True)
        for leftover in self.incoming.iterdir():
            if leftover.is_file():
                leftover.unlink()

    def check(self) -> None:
        """Nothing: the folder was there when the server started."""

    def path(self, sha256: str) -> Path:
        """Where a blob is, or would be."""
        return self.blobs / sha256[0] / sha256

    def blob(self, sha256: str) -> FileBlob:
        """A blob for a job to read."""
        return FileBlob(self.path(sha256))

    def streamed(self, sha256: str) -> LocalFile:
        """A blob for a job to read in pieces."""
        return LocalFile(self.path(sha256), sha256)

    def writer(self) -> BlobWriter:
        """Begin a new blob."""
        return BlobWriter(self.incoming)

    async def bring(self, written: Sequence[WrittenBlob], threads: Executor) -> None:
        """Nothing: sub-maps that wait together are synced together, see `SubmapCommits`."""

    def adopt(self, written: Iterable[WrittenBlob]) -> list[str]:
        """Move complete blobs to their places, durably; returns the digests that are new.

        A stored file with other content than its name says is replaced: it was damaged.
        """
        written = [blob for blob in written if isinstance(blob, BlobWriter)]
        sync_all([blob.path for blob in written if not blob.synced])
        fresh, folders = [], set[Path]()
        for blob in written:
            place = self.path(blob.sha256)
            folders.add(place.parent)
            known = place.exists()
            if known and _digest_of(place) == blob.sha256:
                blob.discard()
                continue
            os.replace(blob.path, place)
            if not known:
                fresh.append(blob.sha256)
        sync_all(sorted(folders))
        return fresh

    def remove(self, digests: Iterable[str]) -> None:
        """Delete blobs that nothing refers to."""
        for sha256 in digests:
            self.path(sha256).unlink(missing_ok=True)

    def total_bytes(self, digests: Iterable[str]) -> int:
        """Length of these blobs together; a missing one counts as nothing."""
        places = [self.path(sha256) for sha256 in digests]
        return sum(place.stat().st_size for place in places if place.exists())

    def names(self, shard: str = "") -> Iterator[str]:
        """The digest of every stored blob that begins like this."""
        for folder in sorted(self.blobs.glob(f"{shard[:1]}*")):
            yield from sorted(entry.name for entry in folder.glob(f"{shard}*"))

    def read(self, sha256: str) -> bytes:
        """A blob's bytes, checked against its name."""
        return read_checked(self.path(sha256))

    def read_piece(self, sha256: str, offset: int, length: int = _READ_BYTES) -> bytes:
        """At most `length` bytes from `offset`; empty at the end."""
        try:
            with self.path(sha256).open("rb") as file:
                file.seek(offset)
                return file.read(length)
        except FileNotFoundError:
            raise NotFound("what is being read has been deleted") from None

    def damage(self, sha256: str) -> str:
        """What is wrong with a stored file that does not match its name, and what helps."""
        return damage(self.path(sha256))


class SharedBlobFolder(BlobFolder):
    """A folder that other servers write to as well.

    Any of them may have come to rely on a blob, so none is taken back when a transaction fails, or
    is not known to have failed: what nothing refers to is collected later, see `CommitLock`.
    """

    def adopt(self, written: Iterable[WrittenBlob]) -> list[str]:
        """Move complete blobs to their places, durably. Nothing is to be taken back."""
        super().adopt(written)
        return []


class BlobWriter:
    """A blob that is being written."""

    def __init__(self, folder: Path, *, name: str | None = None) -> None:
        """A new file in `folder`; with `name` that file, whose content `note` has to be told."""
        if name is None:
            descriptor, path = tempfile.mkstemp(dir=folder)
            self.path = Path(path)
            self._file = os.fdopen(descriptor, "wb")
        else:
            self.path = folder / name
            self._file = self.path.open("ab")
        self.length = 0
        self.synced = False
        """Whether all that was written is on the disk."""
        self._digest = hashlib.sha256()

    @property
    def sha256(self) -> str:
        """Digest of what was written so far, in hex."""
        return self._digest.hexdigest()

    def write(self, data: bytes) -> None:
        """Append bytes; DiskFull when there is no room."""
        with translated_disk_errors():
            self._file.write(data)
        self.note(data)

    def note(self, data: bytes) -> None:
        """Count bytes that the file holds already."""
        self.synced = False
        self._digest.update(data)
        self.length += len(data)

    def flush(self) -> None:
        """Hand what was written to the operating system: it survives this process."""
        with translated_disk_errors():
            self._file.flush()

    def finish(self) -> None:
        """Nothing is appended afterwards; `BlobFolder.adopt` brings it to the disk."""
        self.flush()
        self._file.close()

    def content(self) -> bytes:
        """All of a finished blob."""
        return self.path.read_bytes()

    def close(self) -> None:
        """Close the file, whatever state it is in."""
        with contextlib.suppress(OSError):  # a full disk refuses what is buffered once more
            self._file.close()

    def reopen(self) -> None:
        """Append again to a file that was closed."""
        self._file = self.path.open("ab")

    def discard(self) -> None:
        """Remove the file, whatever state it is in."""
        self.close()
        self.path.unlink(missing_ok=True)


class translated_disk_errors:  # noqa: N801  # a context manager reads as a verb
    """Raise DiskFull, which passes once there is room again, for a full disk."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            message = "the server's disk is full; try again once there is room"
            raise DiskFull(message, retry_after_s=DISK_RETRY_S) from error


def read_checked(path: Path) -> bytes:
    """The bytes of a stored blob. NotFound without it, CorruptData when it is not what it was."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise NotFound(f"the stored file {path} is missing; restore it from a backup") from None
    if hashlib.sha256(data).hexdigest() != path.name:
        raise CorruptData(damage(path))
    return data


def damage(path: Path) -> str:
    """What is wrong with a stored file that does not match its name, and what helps."""
    return (
        f"the stored file {path} is damaged: its SHA-256 is not its name; restore it from a "
        "backup, or delete the sub-map or map that it belongs to"
    )


def _digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync_all(paths: Sequence[Path]) -> None:
    """Make files and folders durable, several at a time: a disk takes them in one go."""
    with ThreadPoolExecutor(SYNCS_AT_ONCE, thread_name_prefix="magic-sync") as threads:
        for done in [threads.submit(_sync, path) for path in paths]:
            with translated_disk_errors():
                done.result()


def _sync(path: Path) -> None:
    """Make what was written to a file, or the names in a folder, durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
