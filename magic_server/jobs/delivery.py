"""How the files of a job come to the server: through a folder that both see, or through a bucket.

A merge and a preview make files of any size and say how far they are. Where the job runs beside
the server, or shares its data folder, they are made in a folder of the server's. Where all that
both reach is a bucket, the job works in a folder of its own, which is gone afterwards, and leaves
its files in the bucket.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from magic_core.errors import MagicError, NotFound
from magic_server.store import Store, WrittenBlob
from magic_server.store.blob_store import StreamedFile
from magic_server.store.blobs import LocalFile
from magic_server.store.bucket import BucketFile, Delivered, delete, put_file, whole
from magic_server.store.bucket_client import BucketPlace, client_of

JobFile = Path | Delivered
"""A file that a job made, as the server finds it."""
Progress = tuple[float, str]
"""Share done, and stage."""
POLL_S = 0.25
_PROGRESS = "progress.json"
_FAR_PROGRESS_S = 2.0


class OpenFile(Protocol):
    """A file that is read from front to end."""

    def read(self, length: int, /) -> bytes:
        """At most `length` further bytes; empty at the end."""
        ...

    def close(self) -> None:
        """No more is read."""
        ...


class Delivery(Protocol):
    """Where one job works and leaves its files; known to the job and to the server."""

    @contextmanager
    def working(self) -> Iterator[Path]:
        """The job's folder, for a block."""
        ...

    def deliver(self, path: Path) -> JobFile:
        """Hand over a file of that folder."""
        ...

    def report(self, progress: Progress) -> None:
        """Say how far the job is; the folder says so already."""
        ...

    def progress(self) -> Progress | None:
        """What was last reported; for the server."""
        ...

    def clear(self) -> None:
        """Remove what the job left; for the server."""
        ...


@dataclass(frozen=True, slots=True)
class FolderDelivery:
    """Through a folder of the server's, which keeps what an interrupted job made."""

    folder: Path

    @contextmanager
    def working(self) -> Iterator[Path]:
        """The job's folder, for a block."""
        yield self.folder

    def deliver(self, path: Path) -> JobFile:
        """Hand over a file of that folder."""
        return path

    def report(self, progress: Progress) -> None:
        """Nothing: the server reads it in the folder."""

    def progress(self) -> Progress | None:
        """What was last reported; for the server."""
        with suppress(FileNotFoundError):
            return _parsed((self.folder / _PROGRESS).read_bytes())
        return None

    def clear(self) -> None:
        """Remove what the job left; for the server."""
        shutil.rmtree(self.folder, ignore_errors=True)


@dataclass(frozen=True, slots=True)
class BucketDelivery:
    """Through a bucket. A job that is tried again begins anew."""

    place: BucketPlace
    beginning: str
    """Of the keys that this job may write; it ends in a slash."""
    scratch: Path
    """A folder in which the job may work, on whichever machine it runs."""

    @contextmanager
    def working(self) -> Iterator[Path]:
        """The job's folder, for a block."""
        self.scratch.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="job-", dir=self.scratch) as folder:
            yield Path(folder)

    def deliver(self, path: Path) -> JobFile:
        """Hand over a file of that folder."""
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        # Under a name of its own: an earlier try may still be writing.
        key = f"{self.beginning}{uuid.uuid4().hex}"
        put_file(client_of(self.place), path, key)
        return Delivered(key, digest, path.stat().st_size)

    def report(self, progress: Progress) -> None:
        """Say how far the job is; a bucket that is away does not end it."""
        with suppress(MagicError):
            client = client_of(self.place)
            path = self.place.path(f"{self.beginning}{_PROGRESS}")
            client.run("put", client.files._pipe_file(path, json.dumps(progress).encode()))

    def progress(self) -> Progress | None:
        """What was last reported; for the server."""
        try:
            return _parsed(whole(client_of(self.place), f"{self.beginning}{_PROGRESS}"))
        except NotFound:
            return None

    def clear(self) -> None:
        """Remove what the job left; for the server. What cannot be removed now goes at a start."""
        with suppress(MagicError):
            delete(client_of(self.place), below=self.beginning)


class Deliveries:
    """Chooses how the files of a server's jobs come to it."""

    def __init__(self, store: Store, *, shares_folder: bool) -> None:
        """`shares_folder`: whether a job sees the server's data folder."""
        self._store = store
        self._bucket = None if shares_folder else store.bucket
        self.poll_s = POLL_S if self._bucket is None else _FAR_PROGRESS_S
        """How often to ask for progress."""

    def of(self, folder: Path) -> Delivery:
        """That of a job which, were it here, would work in this folder below the scratch."""
        if self._bucket is None:
            return FolderDelivery(folder)
        job = folder.relative_to(self._store.scratch).as_posix()
        scratch = self._store.folder / "jobs"
        return BucketDelivery(self._bucket.place, self._bucket.beginning_of(job), scratch)

    def adoptable(self, file: Delivered) -> WrittenBlob:
        """What a job left in the bucket, for the store to adopt."""
        assert self._bucket is not None  # nobody else delivers there
        return self._bucket.delivered(file)

    def streamed(self, file: JobFile, sha256: str) -> StreamedFile:
        """What a job made, for another job to read."""
        if isinstance(file, Path):
            return LocalFile(file, sha256)
        assert self._bucket is not None
        return BucketFile(self._bucket.place, file.key, sha256)

    def opened(self, file: JobFile) -> OpenFile:
        """What a job made, for reading. Blocks."""
        if isinstance(file, Path):
            return file.open("rb")
        assert self._bucket is not None
        return self._bucket.reader(file)


class SpacedReports:
    """Passes reports on, and not more often than a bucket should hear them."""

    def __init__(self, delivery: Delivery) -> None:
        self._delivery = delivery
        self._at = -_FAR_PROGRESS_S

    def __call__(self, share: float, stage: str) -> None:
        """Report, unless that was done just now."""
        if time.monotonic() - self._at >= _FAR_PROGRESS_S:
            self._at = time.monotonic()
            self._delivery.report((share, stage))


def _parsed(data: bytes) -> Progress | None:
    try:
        share, stage = json.loads(data)
    except ValueError:
        return None
    return float(share), str(stage)
