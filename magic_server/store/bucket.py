"""Blobs in an S3 bucket, for servers and workers that share no file system.

    {prefix}/blobs/{first hex digit}/{sha256 in hex}   complete, never changed
    {prefix}/incoming/{server}/{random}                on their way in; emptied at every start
    {prefix}/jobs/{job}/...                            what jobs leave that outlast a server
    {prefix}/database-id                               whose blobs these are

What agents send is spooled in the data folder until the sub-map is whole, then put here; archives
and merged maps stream through memory, a part at a time. Objects of more than two parts go up in
parts. Every method that is no coroutine blocks.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from magic_core.errors import CorruptData, NotFound, WrongState
from magic_server.store.blob_cache import BlobCache
from magic_server.store.blob_store import BlobObserver, WrittenBlob
from magic_server.store.blobs import BlobWriter
from magic_server.store.bucket_client import (
    BucketClient,
    BucketPlace,
    client_of,
    code_of,
    look,
    open_checked,
)
from magic_server.store_config import StoreConfig

logger = logging.getLogger(__name__)

_READ_BYTES = 1 << 20
_LOOKED_UP = 256
"""Blobs whose lengths are asked for one by one; more are found in lists."""
_ABANDONED = timedelta(days=1)
_ID_KEY = "database-id"
_CACHE = "blob-cache"
_JOBS = "jobs/"
_INVALID_RANGE = ("InvalidRange", "416")


@dataclass(frozen=True, slots=True)
class BucketBlob:
    """A blob in a bucket, read through a cache of this machine's."""

    place: BucketPlace
    sha256: str

    def read(self) -> bytes:
        """All of it, checked. NotFound without it, CorruptData when it is not what it was."""
        cache = BlobCache(self.place.cache, self.place.cache_bytes)
        data = cache.get(self.sha256)
        if data is None:
            data = _read(client_of(self.place), self.sha256)
            cache.put(self.sha256, data)
        return data

    def head(self, length: int) -> bytes:
        """Its first bytes, unchecked."""
        kept = BlobCache(self.place.cache, self.place.cache_bytes).get(self.sha256)
        if kept is not None:
            return kept[:length]
        return _read_piece(client_of(self.place), _key(self.sha256), 0, length)


class StagedBlob:
    """A blob that streams into the bucket, under another name until the store adopts it."""

    def __init__(self, client: BucketClient, key: str) -> None:
        self.key = key
        self.length = 0
        self._client = client
        self._digest = hashlib.sha256()
        self._seconds = 0.0
        self._there = False
        with client.translated():
            self._file: Any = client.files.open(
                client.place.path(key), "wb", block_size=client.place.part_bytes
            )

    @property
    def sha256(self) -> str:
        """Digest of what was written so far, in hex."""
        return self._digest.hexdigest()

    def write(self, data: bytes) -> None:
        """Append bytes; at most a part waits in memory."""
        self._digest.update(data)
        self.length += len(data)
        self._timed(self._file.write, data)

    def finish(self) -> None:
        """Nothing is appended afterwards; the object is whole and durable."""
        outcome = "failed"
        try:
            self._timed(self._file.close)
            self._there = True
            outcome = "ok"
        finally:
            self._client.observe("put", outcome, self._seconds)

    def content(self) -> bytes:
        """All of a finished one, checked."""
        data = whole(self._client, self.key)
        if hashlib.sha256(data).hexdigest() != self.sha256:
            raise CorruptData(f"s3://{self._client.place.path(self.key)} was changed by somebody")
        return data

    def adopted(self) -> None:
        """The store has it under its name."""
        self._there = False

    def discard(self) -> None:
        """Remove what the store has not adopted, whatever state it is in."""
        if not self._file.closed:
            with self._client.translated():
                self._file.discard()
            self._file.closed = True  # else its finaliser would upload it after all
        if self._there:
            _delete(self._client, [self.key])
            self._there = False

    def _timed(self, function: Any, *arguments: Any) -> None:
        begun = time.perf_counter()
        try:
            with self._client.translated():
                function(*arguments)
        finally:
            self._seconds += time.perf_counter() - begun


@dataclass(frozen=True, slots=True)
class BucketFile:
    """An object that is read in pieces."""

    place: BucketPlace
    key: str
    sha256: str

    def pieces(self) -> Iterator[bytes]:
        """All of it in order. NotFound without it, CorruptData when it is not what it was."""
        digest = hashlib.sha256()
        for piece in object_pieces(client_of(self.place), self.key):
            digest.update(piece)
            yield piece
        if digest.hexdigest() != self.sha256:
            raise CorruptData(_damage(self.place, self.key))


@dataclass(frozen=True, slots=True)
class Delivered:
    """A file that a job left in the bucket."""

    key: str
    sha256: str
    length: int


class DeliveredBlob(StagedBlob):
    """Such a file as a blob for the store to adopt."""

    def __init__(self, client: BucketClient, file: Delivered) -> None:
        self.key, self.length = file.key, file.length
        self._client, self._sha256 = client, file.sha256
        self._there = True

    @property
    def sha256(self) -> str:
        """Digest of the content, in hex."""
        return self._sha256

    def write(self, data: bytes) -> None:
        """It is whole already."""
        raise WrongState(f"{self.key} is whole")

    def finish(self) -> None:
        """Nothing: it is whole already."""

    def discard(self) -> None:
        """Nothing: whoever asked for the job removes what it left."""


class DeliveredReader:
    """Reads such a file from its beginning, as an open file is read."""

    def __init__(self, client: BucketClient, file: Delivered) -> None:
        self._client, self._key, self._offset = client, file.key, 0

    def read(self, length: int) -> bytes:
        """At most `length` further bytes; empty at the end."""
        data = _read_piece(self._client, self._key, self._offset, length)
        self._offset += len(data)
        return data

    def close(self) -> None:
        """Nothing is held."""


class BucketBlobs:
    """Objects named by the SHA-256 of their content. Several servers may share them.

    None is taken back when a transaction fails: what nothing refers to is collected later.
    """

    far = True
    shards: Sequence[str] = tuple("0123456789abcdef")

    def __init__(
        self,
        place: BucketPlace,
        *,
        server: str,
        observer: BlobObserver = lambda operation, outcome, s: None,
    ) -> None:
        """`server` is a name that no other server on the bucket has."""
        self.place = place
        self._client = BucketClient(place, observer=observer)
        self._incoming = f"incoming/{server or 'server'}/"

    def open(self) -> None:
        """Drop what a dead server was writing. ConfigError or Unavailable without the bucket."""
        open_checked(self._client)
        delete(self._client, below=self._incoming)
        self._abort_uploads()

    def check(self) -> None:
        """Raise Unavailable while the bucket does not answer."""
        look(self._client)

    def blob(self, sha256: str) -> BucketBlob:
        """A blob for a job to read."""
        return BucketBlob(self.place, sha256)

    def streamed(self, sha256: str) -> BucketFile:
        """A blob for a job to read in pieces."""
        return BucketFile(self.place, _key(sha256), sha256)

    def writer(self) -> StagedBlob:
        """Begin a new blob."""
        return StagedBlob(self._client, f"{self._incoming}{uuid.uuid4().hex}")

    def beginning_of(self, job: str, *, lasting: bool) -> str:
        """Of the keys that a job of this name may write; a start of the server removes them, those
        of a `lasting` one only as it is asked to."""
        return f"{_JOBS if lasting else self._incoming}{job}/"

    def lasting_jobs(self) -> set[str]:
        """First part of the names of all lasting jobs that left something."""
        found = listed(self._client, _JOBS)
        return {key.removeprefix(_JOBS).partition("/")[0] for key, _ in found}

    def delivered(self, file: Delivered) -> DeliveredBlob:
        """What a job left, for `adopt`."""
        return DeliveredBlob(self._client, file)

    def reader(self, file: Delivered) -> DeliveredReader:
        """What a job left, to be read."""
        return DeliveredReader(self._client, file)

    async def bring(self, written: Sequence[WrittenBlob], threads: Executor) -> None:
        """Upload what lies in the spool: nobody else's commit waits for it."""
        await asyncio.get_running_loop().run_in_executor(threads, self._upload, written)

    def adopt(self, written: Iterable[WrittenBlob]) -> list[str]:
        """Have blobs under their names, durably. Nothing is to be taken back."""
        written = list(written)
        spooled = [blob for blob in written if isinstance(blob, BlobWriter)]
        # A server that removed what nothing referred to may have removed what came since.
        gone = [b for b, there in zip(spooled, self._there(spooled), strict=True) if not there]
        self._upload(gone)
        staged = [blob for blob in written if isinstance(blob, StagedBlob)]
        path, copy = self.place.path, self._client.files._cp_file
        copies = [copy(path(blob.key), path(_key(blob.sha256))) for blob in staged]
        self._client.run_all("copy", copies)
        for blob in staged:
            blob.adopted()
        _delete(self._client, [blob.key for blob in staged])
        return []

    def remove(self, digests: Iterable[str]) -> None:
        """Delete blobs that nothing refers to."""
        _delete(self._client, [_key(sha256) for sha256 in digests])

    def total_bytes(self, digests: Iterable[str]) -> int:
        """Length of these blobs together; a missing one counts as nothing."""
        wanted = set(digests)
        if len(wanted) <= _LOOKED_UP:
            return sum(filter(None, self._lengths(sorted(wanted))))
        shards = sorted({sha256[0] for sha256 in wanted})
        found = (pair for shard in shards for pair in listed(self._client, _shard(shard)))
        return sum(length for key, length in found if key.rpartition("/")[2] in wanted)

    def names(self, shard: str = "") -> Iterator[str]:
        """The digest of every stored blob that begins like this."""
        for key, _ in listed(self._client, _shard(shard)):
            yield key.rpartition("/")[2]

    def read(self, sha256: str) -> bytes:
        """A blob's bytes, checked against its name."""
        return _read(self._client, sha256)

    def read_piece(self, sha256: str, offset: int, length: int = _READ_BYTES) -> bytes:
        """At most `length` bytes from `offset`, unchecked; empty at the end."""
        return _read_piece(self._client, _key(sha256), offset, length)

    def damage(self, sha256: str) -> str:
        """What is wrong with a stored blob that does not match its name, and what helps."""
        return _damage(self.place, _key(sha256))

    def mark(self, identity: str) -> None:
        """Write down whose blobs these are, where nobody has; WrongState for another's."""
        if self._owner() is None:
            mark = self._client.files._pipe_file(self.place.path(_ID_KEY), identity.encode())
            self._client.run("put", mark)
        self.require(identity, may_be_new=False)  # two databases may have been begun at once

    def require(self, identity: str, *, may_be_new: bool) -> None:
        """Raise WrongState unless the bucket's blobs are those of a database.

        `may_be_new`: the database refers to no blob yet, so that the bucket may be nobody's.
        """
        open_checked(self._client)
        found = self._owner()
        if found != identity and not (found is None and may_be_new):
            theirs = "no database's" if found is None else f"those of database {found}"
            raise WrongState(
                f"{self.place} does not hold the blobs of this database ({identity}): they are "
                f"{theirs}; give the bucket and prefix that it was begun with, or move sessions "
                "with `magic sessions export` and `import` into a new database and prefix"
            )

    def _owner(self) -> str | None:
        try:
            return whole(self._client, _ID_KEY).decode("utf-8", "replace").strip()
        except NotFound:
            return None

    def _upload(self, written: Sequence[WrittenBlob]) -> None:
        put, place = self._client.files._put_file, self.place
        spooled = [blob for blob in written if isinstance(blob, BlobWriter)]
        works = [
            put(blob.path, place.path(_key(blob.sha256)), chunksize=place.part_bytes)
            for blob in spooled
        ]
        self._client.run_all("put", works)

    def _there(self, written: Sequence[BlobWriter]) -> list[bool]:
        lengths = self._lengths([blob.sha256 for blob in written])
        return [blob.length == length for blob, length in zip(written, lengths, strict=True)]

    def _lengths(self, digests: Sequence[str]) -> list[int | None]:
        """Of each blob its length, None without it."""
        return self._client.run_all("head", [self._length(sha256) for sha256 in digests])

    async def _length(self, sha256: str) -> int | None:
        # The first byte, not HEAD: some servers answer that for what is missing in a way that
        # breaks the connection.
        key = self.place.key(_key(sha256))
        try:
            found = await self._client.files._call_s3(
                "get_object", Bucket=self.place.bucket, Key=key, Range="bytes=0-0"
            )
        except FileNotFoundError:
            return None
        except OSError as error:
            if code_of(error) in _INVALID_RANGE:
                return 0
            raise
        async with found["Body"] as body:
            await body.read()
        return int(found["ContentRange"].rpartition("/")[2])

    def _abort_uploads(self) -> None:
        """End uploads in parts that nobody goes on with: their parts are paid for."""
        page = self._client.call("list", "list_multipart_uploads", Prefix=self.place.key(""))
        now, mine = datetime.now(UTC), self.place.key(self._incoming)
        for upload in page.get("Uploads") or ():
            key, begun = upload["Key"], upload["Initiated"]
            if key.startswith(mine) or now - begun > _ABANDONED:
                self._client.call(
                    "delete", "abort_multipart_upload", Key=key, UploadId=upload["UploadId"]
                )


def listed(client: BucketClient, beginning: str) -> Iterator[tuple[str, int]]:
    """Key, without the prefix, and length of every object below; a page in memory at a time."""
    skip = len(client.place.key(""))
    more: dict[str, str] = {}
    while True:
        page = client.call("list", "list_objects_v2", Prefix=client.place.key(beginning), **more)
        for entry in page.get("Contents", ()):
            yield entry["Key"][skip:], int(entry["Size"])
        if not page.get("IsTruncated"):
            return
        more = {"ContinuationToken": page["NextContinuationToken"]}


def delete(client: BucketClient, *, below: str) -> None:
    """Delete every object whose key begins like this."""
    _delete(client, [key for key, _ in listed(client, below)])


def put_file(client: BucketClient, path: Path, key: str) -> None:
    """Upload a file, in parts where it is long."""
    put, place = client.files._put_file, client.place
    client.run("put", put(path, place.path(key), chunksize=place.part_bytes))


def bucket_of(config: StoreConfig, folder: Path) -> BucketPlace | None:
    """The bucket that the settings name, None where blobs are files; `folder`: the data folder."""
    if not config.blobs:
        return None
    bucket, _, prefix = config.blobs.removeprefix("s3://").strip("/").partition("/")
    return BucketPlace(
        bucket=bucket,
        prefix=prefix,
        endpoint=config.s3_endpoint.rstrip("/"),
        region=config.s3_region,
        part_bytes=config.s3_part_bytes,
        timeout_s=config.s3_timeout_s,
        cache=folder / _CACHE,
        cache_bytes=config.blob_cache_bytes,
    )


def _key(sha256: str) -> str:
    return f"blobs/{sha256[0]}/{sha256}"


def _shard(beginning: str) -> str:
    return f"blobs/{beginning[0]}/{beginning}" if beginning else "blobs/"


def _read(client: BucketClient, sha256: str) -> bytes:
    try:
        data = whole(client, _key(sha256))
    except NotFound:
        where = client.place.path(_key(sha256))
        raise NotFound(f"the stored blob s3://{where} is missing; restore it") from None
    if hashlib.sha256(data).hexdigest() != sha256:
        raise CorruptData(_damage(client.place, _key(sha256)))
    return data


def whole(client: BucketClient, key: str) -> bytes:
    """All of an object, unchecked; NotFound without it."""
    return client.run("get", client.files._cat_file(client.place.path(key), max_concurrency=1))


def object_pieces(client: BucketClient, key: str) -> Iterator[bytes]:
    """All of an object in order, unchecked; NotFound without it."""
    offset = 0
    while piece := _read_piece(client, key, offset, client.place.part_bytes):
        offset += len(piece)
        yield piece


def _read_piece(client: BucketClient, key: str, offset: int, length: int) -> bytes:
    try:
        return client.run("get", _ranged(client, key, offset, length))
    except NotFound:
        raise NotFound("what is being read has been deleted") from None


async def _ranged(client: BucketClient, key: str, offset: int, length: int) -> bytes:
    path = client.place.path(key)
    try:
        return await client.files._cat_file(path, start=offset, end=offset + length)
    except OSError as error:
        if code_of(error) in _INVALID_RANGE:  # behind the end
            return b""
        raise


def _delete(client: BucketClient, keys: Sequence[str]) -> None:
    # One by one: the request for several wants a checksum that not every S3 server knows.
    remove, path = client.files._rm_file, client.place.path
    client.run_all("delete", [remove(path(key)) for key in keys])


def _damage(place: BucketPlace, key: str) -> str:
    return (
        f"the stored blob s3://{place.path(key)} is damaged: its SHA-256 is not its name; "
        "restore it from a backup, or delete the sub-map or map that it belongs to"
    )
