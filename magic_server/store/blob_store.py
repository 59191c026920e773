"""What a store of blobs must do. The rest of the server knows no more of it than this.

Blobs are named by the SHA-256 of their content, in hex. They lie in the data folder (blobs.py) or
in an S3 bucket (bucket.py). Every method that is no coroutine blocks: call it on a thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from typing import Protocol

BlobObserver = Callable[[str, str, float], None]
"""Called with the operation on a bucket, its outcome and the seconds it took; from any thread."""


class StoredBlob(Protocol):
    """A stored blob as jobs read it. It holds names alone: it travels to other processes."""

    def read(self) -> bytes:
        """All of it, checked. NotFound without it, CorruptData when it is not what it was."""
        ...

    def head(self, length: int) -> bytes:
        """Its first bytes, unchecked."""
        ...


class StreamedFile(Protocol):
    """A large file as jobs read it. It holds names alone: it travels to other processes."""

    @property
    def sha256(self) -> str:
        """Digest of its content, in hex."""
        ...

    def pieces(self) -> Iterator[bytes]:
        """All of it in order, a piece in memory at a time. NotFound without it, CorruptData at
        the end when it is not what it was."""
        ...


class WrittenBlob(Protocol):
    """A blob on its way in."""

    length: int
    """Bytes so far."""

    @property
    def sha256(self) -> str:
        """Digest of what was written so far, in hex."""
        ...

    def write(self, data: bytes) -> None:
        """Append bytes."""
        ...

    def finish(self) -> None:
        """Nothing is appended afterwards."""
        ...

    def content(self) -> bytes:
        """All of a finished one."""
        ...

    def discard(self) -> None:
        """Remove what the store has not adopted, whatever state it is in."""
        ...


class BlobStore(Protocol):
    """Keeps blobs: whole, durable, and there before anything refers to them."""

    far: bool
    """Whether every look takes a request over the network."""
    shards: Sequence[str]
    """First digits of digests by which blobs are gone through, part by part."""

    def open(self) -> None:
        """Create what is missing and drop what a dead server was writing."""
        ...

    def check(self) -> None:
        """Raise Unavailable where blobs can be neither read nor written at present."""
        ...

    def blob(self, sha256: str) -> StoredBlob:
        """A blob for a job to read."""
        ...

    def streamed(self, sha256: str) -> StreamedFile:
        """A blob for a job to read in pieces."""
        ...

    def writer(self) -> WrittenBlob:
        """Begin a new blob."""
        ...

    async def bring(self, written: Sequence[WrittenBlob], threads: Executor) -> None:
        """Whatever of `adopt` takes long and may be done before anybody waits for it."""
        ...

    def adopt(self, written: Iterable[WrittenBlob]) -> list[str]:
        """Make blobs durable under their names; returns the digests to remove should the
        transaction fail. One that is stored with other content than its name says is replaced."""
        ...

    def remove(self, digests: Iterable[str]) -> None:
        """Delete blobs that nothing refers to."""
        ...

    def total_bytes(self, digests: Iterable[str]) -> int:
        """Length of these blobs together; a missing one counts as nothing."""
        ...

    def names(self, shard: str = "") -> Iterator[str]:
        """The digest of every stored blob that begins like this."""
        ...

    def read(self, sha256: str) -> bytes:
        """A blob's bytes, checked against its name."""
        ...

    def read_piece(self, sha256: str, offset: int, length: int = ...) -> bytes:
        """At most `length` bytes from `offset`, unchecked; empty at the end."""
        ...

    def damage(self, sha256: str) -> str:
        """What is wrong with a stored blob that does not match its name, and what helps."""
        ...
