"""How the files of a job come to the server: through a folder that both see, or through a bucket.

A merge and a preview make files of any size and say how far they are. Where the job runs beside
the server, or shares its data folder, they are made in a folder of the server's. Where all that
both reach is a bucket, the job works in a folder of its own, which is gone afterwards, and leaves
its files in the bucket; there it also leaves how far it was, for whoever begins it again.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
import logging
import os
import shutil
import tarfile
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from magic_core.errors import MagicError, NotFound, Unavailable
from magic_server.store import Store, WrittenBlob
from magic_server.store.blob_store import StreamedFile
from magic_server.store.blobs import LocalFile
from magic_server.store.bucket import (
    BucketFile,
    Delivered,
    delete,
    object_pieces,
    put_file,
    whole,
)
from magic_server.store.bucket_client import BucketPlace, client_of

logger = logging.getLogger(__name__)

T = TypeVar("T")
JobFile = Path | Delivered
"""A file that a job made, as the server finds it."""
Progress = tuple[float, str]
"""Share done, and stage."""
POLL_S = 0.25
_PROGRESS = "progress.json"
_KEPT, _CONCLUDED = "kept.tar", "concluded.json"
_FAR_PROGRESS_S = 2.0
_FAR_KEEP_S = 60.0
_PATIENCE_S, _AGAIN_S = 300.0, 2.0


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
        """The job's folder, for a block, with what an earlier try kept."""
        ...

    def keep(self, paths: Sequence[Path]) -> None:
        """Let a later try find these files of that folder, and none that were kept before."""
        ...

    def deliver(self, path: Path) -> JobFile:
        """Hand over a file of that folder."""
        ...

    def conclude(self, name: str, files: Sequence[JobFile]) -> None:
        """Let a later try at the job of this name find what it delivered."""
        ...

    def concluded(self, name: str) -> Sequence[Delivered] | None:
        """What an earlier try at the job of this name delivered, where it came to its end."""
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
        """The job's folder, for a block, with what an earlier try kept."""
        yield self.folder

    def keep(self, paths: Sequence[Path]) -> None:
        """Nothing: they lie in the folder."""

    def deliver(self, path: Path) -> JobFile:
        """Hand over a file of that folder."""
        return path

    def conclude(self, name: str, files: Sequence[JobFile]) -> None:
        """Nothing: a later try finds the files themselves."""

    def concluded(self, name: str) -> Sequence[Delivered] | None:
        """None: a later try looks into the folder."""

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
    """Through a bucket."""

    place: BucketPlace
    beginning: str
    """Of the keys that this job may write; it ends in a slash."""
    scratch: Path
    """A folder in which the job may work, on whichever machine it runs."""
    lasting: bool = False
    """Whether it keeps anything for a later try."""

    @contextmanager
    def working(self) -> Iterator[Path]:
        """The job's folder, for a block, with what an earlier try kept."""
        with _own_folder(self.scratch) as folder:
            if self.lasting:
                _patiently(lambda: self._restore(folder))
            yield folder

    def keep(self, paths: Sequence[Path]) -> None:
        """Let a later try find these files of that folder, and none that were kept before.

        A bucket that is away does not end the job: it keeps them the next time.
        """
        client, folder = client_of(self.place), paths[0].parent
        with suppress(MagicError), tempfile.NamedTemporaryFile(dir=folder) as file:
            with tarfile.open(fileobj=file, mode="w") as tar:
                for path in paths:
                    tar.add(path, path.name)
            file.flush()
            put_file(client, Path(file.name), f"{self.beginning}{_KEPT}")

    def _restore(self, folder: Path) -> None:
        with suppress(NotFound), tempfile.TemporaryFile(dir=self.scratch) as file:
            for piece in object_pieces(client_of(self.place), f"{self.beginning}{_KEPT}"):
                file.write(piece)
            file.seek(0)
            try:
                with tarfile.open(fileobj=file, mode="r") as tar:
                    tar.extractall(folder, filter="data")
            except tarfile.TarError:
                logger.warning("what %s kept is damaged; it begins anew", self.beginning)
                for path in folder.iterdir():
                    path.unlink()

    def deliver(self, path: Path) -> JobFile:
        """Hand over a file of that folder."""
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        # Under a name of its own: an earlier try may still be writing.
        key = f"{self.beginning}{uuid.uuid4().hex}"
        _patiently(lambda: put_file(client_of(self.place), path, key))
        return Delivered(key, digest, path.stat().st_size)

    def conclude(self, name: str, files: Sequence[JobFile]) -> None:
        """Let a later try at the job of this name find what it delivered."""
        found = [dataclasses.asdict(file) for file in files if isinstance(file, Delivered)]
        data = json.dumps({"name": name, "files": found}).encode()
        client = client_of(self.place)
        path = self.place.path(f"{self.beginning}{_CONCLUDED}")
        _patiently(lambda: client.run("put", client.files._pipe_file(path, data)))

    def concluded(self, name: str) -> Sequence[Delivered] | None:
        """What an earlier try at the job of this name delivered, where it came to its end."""
        client, key = client_of(self.place), f"{self.beginning}{_CONCLUDED}"
        try:
            said = json.loads(_patiently(lambda: whole(client, key)))
        except NotFound:
            return None
        return [Delivered(**file) for file in said["files"]] if said["name"] == name else None

    def report(self, progress: Progress) -> None:
        """Say how far the job is; a bucket that is away does not end it."""
        with suppress(MagicError):
            client = client_of(self.place)
            path = self.place.path(f"{self.beginning}{_PROGRESS}")
            client.run("put", client.files._pipe_file(path, json.dumps(progress).encode()))

    def progress(self) -> Progress | None:
        """What was last reported; for the server. A bucket that is away does not end the job."""
        with suppress(MagicError):
            return _parsed(whole(client_of(self.place), f"{self.beginning}{_PROGRESS}"))
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

    def of(self, folder: Path, *, lasting: bool = False) -> Delivery:
        """That of a job which, were it here, would work in this folder below the scratch.

        What a `lasting` one leaves in a bucket stays over a start of the server, whichever it is.
        """
        if self._bucket is None:
            return FolderDelivery(folder)
        job = folder.relative_to(self._store.scratch).as_posix()
        scratch = self._store.folder / "jobs"
        beginning = self._bucket.beginning_of(job, lasting=lasting)
        return BucketDelivery(self._bucket.place, beginning, scratch, lasting)

    def lasting(self) -> set[str]:
        """The folders, by name, of which lasting jobs left something in the bucket."""
        if self._bucket is None:
            return set()
        return self._bucket.lasting_jobs()

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


def spaced_keeping(delivery: Delivery, paths: Callable[[], Sequence[Path]]) -> Callable[[], None]:
    """Keeps files when it is called, and not more often than a bucket should take them."""
    kept = time.monotonic()

    def keep() -> None:
        nonlocal kept
        if time.monotonic() - kept >= _FAR_KEEP_S:
            delivery.keep(paths())
            kept = time.monotonic()

    return keep


@contextmanager
def _own_folder(scratch: Path) -> Iterator[Path]:
    """A new folder, which is gone afterwards.

    A job that nobody wants any more is ended with its process: what that left goes with the next.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        with (scratch / "lock").open("a") as gate:
            with suppress(OSError):  # a disk without locks: nothing that is left is removed
                fcntl.flock(gate, fcntl.LOCK_EX)
            for left in scratch.glob("job-*"):
                with suppress(OSError), _locked(left):
                    shutil.rmtree(left)
            own = tempfile.TemporaryDirectory(prefix="job-", dir=scratch)
            folder = Path(stack.enter_context(own))
            with suppress(OSError):
                stack.enter_context(_locked(folder))
        yield folder


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, as long as this process lives; OSError where another has it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _patiently(work: Callable[[], T]) -> T:
    """Do what a job cannot end without, again while the bucket is away: hours may be behind it."""
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return work()
        except Unavailable:
            if time.monotonic() > end:
                raise
            time.sleep(_AGAIN_S)


def _parsed(data: bytes) -> Progress | None:
    try:
        share, stage = json.loads(data)
    except ValueError:
        return None
    return float(share), str(stage)
