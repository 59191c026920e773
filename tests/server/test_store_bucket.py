"""Blobs in a bucket of a real S3 server: what holds of files holds of them."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import hashlib
import logging
import pickle
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from magic_cli.bucket_check import bucket
from magic_core.errors import ConfigError, CorruptData, NotFound, Unavailable, WrongState
from magic_server.jobs.delivery import Deliveries
from magic_server.store import BlobWriter, Store
from magic_server.store.bucket import BucketBlob, BucketBlobs, bucket_of, listed
from magic_server.store.bucket_client import BucketClient
from magic_server.store_config import StoreConfig
from tests.bucket import BucketServer, bucket_server
from tests.server.test_store_durability import NO_DIGESTS, new_submap, registered
from tests.small_world import make_submap
from tests.swift import NoSwift, swift_server

PART = 5 << 20


@pytest.fixture(scope="module", params=["moto", pytest.param("swift", marks=pytest.mark.slow)])
def s3(request: pytest.FixtureRequest) -> Iterator[BucketServer]:
    """Each S3 server in turn."""
    try:
        with bucket_server() if request.param == "moto" else swift_server() as running:
            yield running
    except NoSwift as error:
        pytest.skip(f"Swift cannot be started: {error}")


@pytest.fixture
def config(s3: BucketServer) -> StoreConfig:
    return s3.store(s3_part_bytes=PART, s3_timeout_s=60.0)


def opened(config: StoreConfig, folder: Path, *, server: str = "a") -> BucketBlobs:
    place = bucket_of(config, folder)
    assert place is not None
    blobs = BucketBlobs(place, server=server)
    blobs.open()
    return blobs


@pytest.fixture
def blobs(config: StoreConfig, tmp_path: Path) -> BucketBlobs:
    return opened(config, tmp_path)


@pytest.fixture
async def store(config: StoreConfig, tmp_path: Path) -> AsyncIterator[Store]:
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path / "data", threads, config=config) as running:
            yield running


def spooled(folder: Path, data: bytes) -> BlobWriter:
    blob = BlobWriter(folder)
    blob.write(data)
    blob.finish()
    return blob


def streamed(blobs: BucketBlobs, data: bytes):
    blob = blobs.writer()
    for begin in range(0, len(data), 1 << 20):
        blob.write(data[begin : begin + (1 << 20)])
    blob.finish()
    return blob


def keys(config: StoreConfig) -> list[str]:
    """What lies in the bucket, below the prefix."""
    place = bucket_of(config, Path())
    assert place is not None
    return sorted(key for key, _ in listed(BucketClient(place), ""))


def path_of(config: StoreConfig, digest: str) -> str:
    return f"{config.blobs.removeprefix('s3://')}/blobs/{digest[0]}/{digest}"


@pytest.mark.parametrize("way", ["spooled", "streamed"])
@pytest.mark.parametrize("size", [10, 3 * PART + 17], ids=["small", "in parts"])
def test_a_blob_is_named_by_its_content_and_checked_when_read(
    s3: BucketServer, config: StoreConfig, tmp_path: Path, *, way: str, size: int
) -> None:
    blobs = opened(config, tmp_path)
    data = hashlib.sha256(b"seed").digest() * (size // 32 + 1)
    digest = hashlib.sha256(data).hexdigest()
    blob = spooled(tmp_path, data) if way == "spooled" else streamed(blobs, data)
    assert blob.content() == data
    blobs.adopt([blob])
    assert keys(config) == [f"blobs/{digest[0]}/{digest}"]
    assert list(blobs.names()) == list(blobs.names(digest[0])) == [digest]
    assert blobs.read(digest) == data
    assert blobs.read_piece(digest, 3, 5) == data[3:8]
    assert blobs.read_piece(digest, len(data)) == b""
    assert blobs.total_bytes([digest, "ab" * 32]) == len(data)
    etag = s3.files().info(path_of(config, digest))["ETag"].strip('"')
    if way == "spooled":  # a copy of what was streamed may be made in one piece
        assert etag.endswith("-4") == (size > PART)
    s3.files().pipe_file(path_of(config, digest), data[:-1] + b"x")
    with pytest.raises(CorruptData, match=f"{digest} is damaged"):
        blobs.read(digest)
    blobs.adopt([spooled(tmp_path, data)])  # its length is right: nobody notices before it is read
    blobs.remove([digest])
    blobs.remove([digest])
    with pytest.raises(NotFound, match=digest):
        blobs.read(digest)


async def test_what_is_brought_again_replaces_what_was_damaged(
    s3: BucketServer, config: StoreConfig, blobs: BucketBlobs, tmp_path: Path
) -> None:
    blob = spooled(tmp_path, b"content")
    with ThreadPoolExecutor(1) as threads:
        await blobs.bring([blob], threads)
        s3.files().pipe_file(path_of(config, blob.sha256), b"another")
        await blobs.bring([blob], threads)
    assert blobs.read(blob.sha256) == b"content"
    blobs.remove([blob.sha256])  # another server found it unused between `bring` and `adopt`
    blobs.adopt([blob])
    assert blobs.read(blob.sha256) == b"content"


def test_what_streams_in_takes_no_disk_and_leaves_nothing_when_it_breaks_off(
    s3: BucketServer, config: StoreConfig, blobs: BucketBlobs, tmp_path: Path
) -> None:
    kept = sorted(tmp_path.rglob("*"))
    begun, whole = blobs.writer(), streamed(blobs, bytes(3 * PART))
    begun.write(bytes(2 * PART))
    assert sorted(tmp_path.rglob("*")) == kept
    begun.discard()
    whole.discard()
    whole.discard()
    assert keys(config) == []
    bucket = config.blobs.split("/")[2]
    assert not s3.files().list_multipart_uploads(bucket)


def test_what_a_dead_server_was_writing_is_dropped_and_what_others_write_is_kept(
    s3: BucketServer, config: StoreConfig, tmp_path: Path
) -> None:
    dead, other = opened(config, tmp_path), opened(config, tmp_path, server="b")
    streamed(dead, b"whole but not adopted")
    cut = dead.writer()
    cut.write(bytes(2 * PART))
    theirs = streamed(other, b"another server's")
    opened(config, tmp_path)
    assert [key.split("/")[1] for key in keys(config)] == ["b"]
    assert not s3.files().list_multipart_uploads(config.blobs.split("/")[2])
    other.adopt([theirs])
    assert other.read(theirs.sha256) == b"another server's"
    cut._file.closed = True  # the dead server's own finaliser must not run


def test_jobs_read_through_a_bounded_cache_that_is_checked(
    s3: BucketServer, config: StoreConfig, tmp_path: Path
) -> None:
    config = dataclasses.replace(config, blob_cache_bytes=64_000)
    blobs = opened(config, tmp_path)
    contents = [bytes([number]) * 900 for number in range(100)]
    written = [spooled(tmp_path, data) for data in contents]
    blobs.adopt(written)
    handles = [blobs.blob(blob.sha256) for blob in written]
    assert s3.key not in repr(handles)
    handles = pickle.loads(pickle.dumps(handles))
    assert [handle.read() for handle in handles] == contents
    cache = blobs.place.cache
    kept = {file.name for file in cache.iterdir()}
    assert 0 < sum(file.stat().st_size for file in cache.iterdir()) <= 65_000
    newest = handles[-1]
    assert newest.sha256 in kept
    (cache / newest.sha256).write_bytes(b"damaged on this machine's disk")
    assert newest.read() == contents[-1]
    blobs.remove([newest.sha256])
    assert newest.read() == contents[-1]  # from the cache
    assert newest.head(3) == contents[-1][:3]
    with pytest.raises(NotFound):
        BucketBlob(blobs.place, "ab" * 32).read()


async def test_a_job_leaves_files_in_the_bucket_which_the_server_reads_and_adopts(
    config: StoreConfig, store: Store
) -> None:
    deliveries = Deliveries(store, shares_folder=False)
    data = bytes(range(256)) * 1000
    delivery = pickle.loads(pickle.dumps(deliveries.of(store.scratch / "merge-7")))
    assert delivery.progress() is None
    with delivery.working() as folder:
        (folder / "map").write_bytes(data)
        file = pickle.loads(pickle.dumps(delivery.deliver(folder / "map")))
        delivery.report((0.25, "refining"))
    assert not folder.exists()
    assert delivery.progress() == (0.25, "refining")
    with contextlib.closing(deliveries.opened(file)) as opened_file:
        assert opened_file.read(200_000) + opened_file.read(200_000) == data
    blob = deliveries.adoptable(file)
    assert (blob.sha256, blob.length) == (hashlib.sha256(data).hexdigest(), len(data))
    store.blobs.adopt([blob])
    delivery.clear()
    assert keys(config) == [f"blobs/{blob.sha256[0]}/{blob.sha256}", "database-id"]
    assert store.blobs.read(blob.sha256) == data


async def test_a_submap_is_found_again_by_another_store(
    config: StoreConfig, tmp_path: Path
) -> None:
    submap = make_submap()
    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path / "data", threads, config=config) as store:
            made, blobs = new_submap(submap, store)
            assert await store.add_submap(await registered(store), made, blobs, now=2.0) is None
        async with Store(tmp_path / "data", threads, config=config) as store:
            session = await store.agents.session("room")
            stored = await store.submaps.stored(session, "agent_0", 0)
            found = [hashlib.sha256(blob.read()).hexdigest() for blob in stored.blobs]
            assert tuple(found) == made.digests
    assert not (tmp_path / "data" / "blobs").exists()


async def test_blobs_without_a_transaction_are_collected_and_others_stay(store: Store) -> None:
    agent = await registered(store)
    made, blobs = new_submap(make_submap(), store)
    await store.add_submap(agent, made, blobs, now=2.0)
    kept = set(store.blobs.names())
    _, orphans = new_submap(make_submap(index=1), store)
    store.blobs.adopt(orphans)  # as if the server died before the transaction
    broken, blobs = new_submap(make_submap(agent=1), store)
    with pytest.raises(Exception, match="NOT NULL"):
        await store.add_submap(
            await registered(store, "agent_1"),
            dataclasses.replace(broken, digests=NO_DIGESTS), blobs, now=2.0,
        )  # fmt: skip
    lost = set(store.blobs.names()) - kept
    assert len(lost) > len(orphans) // 2
    assert await store.collect_orphans() == len(lost)
    assert set(store.blobs.names()) == kept


async def test_nothing_is_stored_while_the_bucket_is_away_and_everything_afterwards(
    s3: BucketServer, store: Store
) -> None:
    agent = await registered(store)
    made, blobs = new_submap(make_submap(), store)
    with s3.away():
        with pytest.raises(Unavailable, match=r"is away .*does its S3 server run") as error:
            await store.add_submap(agent, made, blobs, now=2.0)
        assert error.value.retry_after_s
        assert await store.submaps.first_answer(agent, 0) is None
        with pytest.raises(Unavailable):
            await asyncio.to_thread(store.blobs.check)
    store.blobs.check()
    made, blobs = new_submap(make_submap(), store)
    assert await store.add_submap(agent, made, blobs, now=3.0) is None
    assert set(store.blobs.names()) == set(made.digests)


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"blobs": "s3://no-such-bucket/x"}, ConfigError, "create the bucket no-such-bucket"),
        ({"s3_endpoint": "http://127.0.0.1:9"}, Unavailable, "is away"),
    ],
)
async def test_what_is_wrong_is_said_at_the_start(
    config: StoreConfig, tmp_path: Path, settings: dict, error: type[Exception], words: str
) -> None:
    wrong = dataclasses.replace(config, **settings)
    with ThreadPoolExecutor(1) as threads, pytest.raises(error, match=words):
        await Store(tmp_path, threads, config=wrong).open()


def test_the_doctor_tries_a_bucket_and_leaves_nothing(config: StoreConfig) -> None:
    assert bucket(config).status == "ok"
    assert keys(config) == []
    found = bucket(dataclasses.replace(config, blobs="s3://no-such-bucket"))
    assert found.status == "fail"
    assert "create the bucket no-such-bucket" in found.detail


async def test_wrong_and_missing_credentials_are_named_and_never_shown(
    s3: BucketServer, config: StoreConfig, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    caplog.set_level(logging.DEBUG)
    with ThreadPoolExecutor(1) as threads:
        with s3.judging(), pytest.raises(ConfigError, match="AWS_ACCESS_KEY_ID") as wrong:
            await Store(tmp_path / "a", threads, config=config).open()
        monkeypatch.delenv("AWS_ACCESS_KEY_ID")
        monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
        with pytest.raises(ConfigError, match="no credentials were found"):
            await Store(tmp_path / "b", threads, config=config).open()
    ours = "\n".join(r.getMessage() for r in caplog.records if not r.name.startswith("moto"))
    assert "aiosqlite" in caplog.text  # it was listened to
    for text in (ours, str(wrong.value), repr(wrong.value.__cause__)):
        assert s3.secret not in text
        assert "Signature=" not in text


@pytest.mark.parametrize(
    "settings",
    [
        {"blobs": "bucket/prefix"},
        {"blobs": "s3://KEY:SECRET@bucket"},
        {"blobs": "s3://bucket", "s3_endpoint": "https://KEY:SECRET@host"},
        {"s3_endpoint": "https://host"},
        {"blobs": "s3://bucket", "s3_part_bytes": 1000},
        {"blobs": "s3://bucket", "s3_timeout_s": 0.0},
    ],
)
def test_settings_that_make_no_sense_are_refused_without_repeating_secrets(settings: dict) -> None:
    with pytest.raises(ConfigError) as error:
        StoreConfig(**settings)
    assert "SECRET" not in str(error.value)


async def test_a_bucket_belongs_to_one_database_and_a_database_to_one_bucket(
    s3: BucketServer, config: StoreConfig, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(1) as threads:

        async def refused(folder: str, config: StoreConfig | None, words: str) -> None:
            store = Store(tmp_path / folder, threads, config=config)
            with pytest.raises(WrongState, match=words):
                await store.open()
            await store.close()

        async with Store(tmp_path / "files", threads) as store:
            made, blobs = new_submap(make_submap(), store)
            await store.add_submap(await registered(store), made, blobs, now=2.0)
        await refused("files", config, "no database's")
        async with Store(tmp_path / "files", threads):
            pass  # that did it no harm
        async with Store(tmp_path / "bucket", threads, config=config) as store:
            made, blobs = new_submap(make_submap(), store)
            await store.add_submap(await registered(store), made, blobs, now=2.0)
        await refused("bucket", None, "are in a bucket; give store.blobs")
        await refused("other", config, "those of database")
        await refused("bucket", s3.store(), "no database's")
        async with Store(tmp_path / "bucket", threads, config=config) as store:
            assert len(list(store.blobs.names())) == len(set(made.digests))
