"""The blob folder: content-addressed files, whole and on disk before anything refers to them.

    blobs/{first hex digit}/{sha256 in hex}   complete, never changed
    incoming/                                 being written; emptied at every start

Every method blocks: call them on a thread.
"""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from magic_core.errors import CorruptData, DiskFull, NotFound

_READ_BYTES = 1 << 20
DISK_RETRY_S = 15.0
"""How long callers are asked to wait when the disk is full."""


class BlobFolder:
    """Files named by the SHA-256 of their content."""

    def __init__(self, root: Path) -> None:
        self.blobs = root / "blobs"
        self.incoming = root / "incoming"

    def open(self) -> None:
        """Create the folders and drop what a dead server was writing."""
        for folder in (self.incoming, *(self.blobs / digit for digit in "0123456789abcdef")):
            folder.mkdir(parents=True, exist_ok=True)
        for leftover in self.incoming.iterdir():
            if leftover.is_file():
                leftover.unlink()

    def path(self, sha256: str) -> Path:
        """Where a blob is, or would be."""
        return self.blobs / sha256[0] / sha256

    def writer(self) -> BlobWriter:
        """Begin a new blob."""
        return BlobWriter(self.incoming)

    def adopt(self, written: Iterable[BlobWriter]) -> list[str]:
        """Move complete blobs to their places, durably; returns the digests that are new."""
        fresh, folders = [], set()
        for blob in written:
            place = self.path(blob.sha256)
            if place.exists():
                blob.discard()
                continue
            os.replace(blob.path, place)
            folders.add(place.parent)
            fresh.append(blob.sha256)
        for folder in folders:
            sync_folder(folder)
        return fresh

    def remove(self, digests: Iterable[str]) -> None:
        """Delete blobs that nothing refers to."""
        for sha256 in digests:
            self.path(sha256).unlink(missing_ok=True)

    def total_bytes(self, digests: Iterable[str]) -> int:
        """Length of these blobs together; a missing one counts as nothing."""
        places = [self.path(sha256) for sha256 in digests]
        return sum(place.stat().st_size for place in places if place.exists())

    def names(self) -> Iterator[str]:
        """The digest of every stored blob."""
        for folder in sorted(self.blobs.iterdir()):
            yield from sorted(entry.name for entry in folder.iterdir())

    def read(self, sha256: str) -> bytes:
        """A blob's bytes, checked against its name."""
        try:
            data = self.path(sha256).read_bytes()
        except FileNotFoundError:
            raise NotFound(f"blob {sha256} is missing from {self.blobs}") from None
        if hashlib.sha256(data).hexdigest() != sha256:
            raise CorruptData(f"blob {sha256} in {self.blobs} does not match its name")
        return data

    def read_piece(self, sha256: str, offset: int, length: int = _READ_BYTES) -> bytes:
        """At most `length` bytes from `offset`; empty at the end."""
        try:
            with self.path(sha256).open("rb") as file:
                file.seek(offset)
                return file.read(length)
        except FileNotFoundError:
            raise NotFound("what is being read has been deleted") from None


class BlobWriter:
    """A blob that is being written in the folder of incoming files."""

    def __init__(self, folder: Path) -> None:
        descriptor, name = tempfile.mkstemp(dir=folder)
        self.path = Path(name)
        self.length = 0
        self._file = os.fdopen(descriptor, "wb")
        self._digest = hashlib.sha256()

    @property
    def sha256(self) -> str:
        """Digest of what was written so far, in hex."""
        return self._digest.hexdigest()

    def write(self, data: bytes) -> None:
        """Append bytes; DiskFull when there is no room."""
        with translated_disk_errors():
            self._file.write(data)
        self._digest.update(data)
        self.length += len(data)

    def finish(self) -> None:
        """Everything to the disk; nothing can be appended afterwards."""
        with translated_disk_errors():
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def discard(self) -> None:
        """Remove the file, whatever state it is in."""
        self._file.close()
        self.path.unlink(missing_ok=True)


class translated_disk_errors:  # noqa: N801  # a context manager reads as a verb
    """Raise DiskFull, which passes once there is room again, for a full disk."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            message = "the server's disk is full; try again once there is room"
            raise DiskFull(message, retry_after_s=DISK_RETRY_S) from error


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
