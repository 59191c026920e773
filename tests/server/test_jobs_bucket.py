"""Jobs of a Dask cluster whose workers share a bucket with the server, and no folder."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from magic_core.errors import CorruptData, Unavailable
from magic_core.tracing import TracingConfig
from magic_server.jobs import JobConfig, JobExecutor, new_executor
from magic_server.jobs.delivery import BucketDelivery
from magic_server.store import BlobWriter
from magic_server.store.bucket import BucketBlob, BucketBlobs, Delivered, bucket_of
from magic_server.store.bucket_client import BucketPlace
from tests.bucket import BucketServer
from tests.cluster import Cluster

pytestmark = pytest.mark.slow


@asynccontextmanager
async def dask_jobs(
    cluster: Cluster, folder: Path, place: BucketPlace, *, timeout_s: float = 60.0
) -> AsyncIterator[JobExecutor]:
    config = JobConfig(executor="dask", scheduler=cluster.address, connect_timeout_s=timeout_s)
    trace = TracingConfig()
    jobs = new_executor(config, folder=folder, trace=trace, observer=lambda *_: None, bucket=place)
    await jobs.start()
    try:
        yield jobs
    finally:
        await jobs.close()


@pytest.fixture
def place(bucket_server: BucketServer, tmp_path: Path) -> BucketPlace:
    (tmp_path / "server").mkdir()
    found = bucket_of(bucket_server.store(), tmp_path / "server")
    assert found is not None
    return found


async def test_workers_read_checked_blobs_and_keep_them_on_their_own_disk(
    cluster: Cluster, bucket_server: BucketServer, place: BucketPlace, tmp_path: Path
) -> None:
    blobs = BucketBlobs(place, server="one")
    blob = BlobWriter(tmp_path)
    blob.write(b"content")
    blob.finish()
    blobs.adopt([blob])
    async with dask_jobs(cluster, tmp_path / "server", place) as jobs:
        assert not jobs.shares_folder
        handle = BucketBlob(place, blob.sha256)
        assert await jobs.run(BucketBlob.read, handle) == b"content"
        theirs: Path = await jobs.run(Path.absolute, place.cache)
        assert theirs == place.cache  # under the data folder on both sides of the border
        assert not place.cache.exists()
        blobs.remove([blob.sha256])
        assert await jobs.run(BucketBlob.read, handle) == b"content"  # from the worker's cache
        damaged = BucketBlob(place, "ab" * 32)
        path = place.path(f"blobs/a/{damaged.sha256}")
        bucket_server.files().pipe_file(path, b"something else")
        with pytest.raises(CorruptData, match=f"{damaged.sha256} is damaged"):
            await jobs.run(BucketBlob.read, damaged)


async def test_a_worker_that_the_bucket_does_not_let_in_is_given_no_jobs(
    cluster: Cluster, place: BucketPlace, tmp_path: Path
) -> None:
    missing = dataclasses.replace(place, bucket="no-such-bucket")
    async with dask_jobs(cluster, tmp_path / "server", missing, timeout_s=20.0) as jobs:
        with pytest.raises(Unavailable, match="create the bucket no-such-bucket"):
            await jobs.run(localize_image)


def localize_image() -> None:
    """A job that is impatient, by its name."""


def lasting(place: BucketPlace, machine: Path) -> BucketDelivery:
    return BucketDelivery(place, "jobs/merge-7/block-0001/", machine, lasting=True)


def test_another_machine_goes_on_with_what_a_job_kept(place: BucketPlace, tmp_path: Path) -> None:
    with lasting(place, tmp_path / "one").working() as folder:
        assert not list(folder.iterdir())
        for name, text in (("plan.json", "plan"), ("open_0000.json", "half"), ("not", "kept")):
            (folder / name).write_text(text)
        lasting(place, tmp_path / "one").keep([folder / "plan.json", folder / "open_0000.json"])
    with lasting(place, tmp_path / "two").working() as folder:
        assert {path.name: path.read_text() for path in folder.iterdir()} == {
            "plan.json": "plan",
            "open_0000.json": "half",
        }
        (folder / "plan.json").write_text("another plan")
        lasting(place, tmp_path / "two").keep([folder / "plan.json"])
    with lasting(place, tmp_path / "one").working() as folder:
        assert [path.read_text() for path in folder.iterdir()] == ["another plan"]


def test_keeping_nothing_new_while_the_bucket_is_away_does_not_end_a_job(
    bucket_server: BucketServer, place: BucketPlace, tmp_path: Path
) -> None:
    delivery = lasting(place, tmp_path / "one")
    impatient = lasting(dataclasses.replace(place, timeout_s=1.0), tmp_path / "one")
    with delivery.working() as folder:
        (folder / "plan.json").write_text("plan")
        with bucket_server.away():
            impatient.keep([folder / "plan.json"])
        (folder / "plan.json").write_text("later")
        delivery.keep([folder / "plan.json"])
    with delivery.working() as folder:
        assert (folder / "plan.json").read_text() == "later"


def test_how_far_a_job_is_can_be_asked_while_the_bucket_is_away(
    bucket_server: BucketServer, place: BucketPlace, tmp_path: Path
) -> None:
    delivery = lasting(place, tmp_path / "one")
    impatient = lasting(dataclasses.replace(place, timeout_s=1.0), tmp_path / "one")
    assert delivery.progress() is None
    delivery.report((0.5, "half"))
    with bucket_server.away():
        assert impatient.progress() is None
    assert delivery.progress() == (0.5, "half")


_ENDED_JOB = """
import os, sys
from pathlib import Path
from magic_server.jobs.delivery import BucketDelivery
with BucketDelivery(None, "jobs/merge-7/", Path(sys.argv[1])).working() as folder:
    (folder / "block").write_bytes(b"refined")
    os.kill(os.getpid(), 15)
"""


def test_what_a_job_left_that_was_ended_with_its_process_goes_with_the_next(
    place: BucketPlace, tmp_path: Path
) -> None:
    ended = subprocess.run([sys.executable, "-c", _ENDED_JOB, str(tmp_path)], timeout=300)
    assert ended.returncode == -signal.SIGTERM
    (left,) = tmp_path.glob("job-*")
    with lasting(place, tmp_path).working() as first:
        assert not left.exists()
        with lasting(place, tmp_path).working() as second:
            assert {first, second} == set(tmp_path.glob("job-*"))
        assert first.is_dir()
    assert not list(tmp_path.glob("job-*"))


def test_what_was_kept_and_is_damaged_is_not_gone_on_with(
    bucket_server: BucketServer, place: BucketPlace, tmp_path: Path
) -> None:
    delivery = lasting(place, tmp_path / "one")
    bucket_server.files().pipe_file(place.path(f"{delivery.beginning}kept.tar"), b"no tar" * 200)
    with delivery.working() as folder:
        assert not list(folder.iterdir())


def test_a_job_that_came_to_its_end_is_found_by_its_name_alone(
    place: BucketPlace, tmp_path: Path
) -> None:
    delivery = lasting(place, tmp_path / "one")
    assert delivery.concluded("block as planned") is None
    with delivery.working() as folder:
        (folder / "block").write_bytes(b"refined")
        file = delivery.deliver(folder / "block")
    delivery.conclude("block as planned", [file])
    assert delivery.concluded("block as planned") == [file]
    assert delivery.concluded("block under other poses") is None
    delivery.clear()
    assert delivery.concluded("block as planned") is None


def test_a_job_that_is_done_waits_for_a_bucket_that_is_away(
    bucket_server: BucketServer, place: BucketPlace, tmp_path: Path
) -> None:
    delivery = lasting(place, tmp_path / "one")
    with delivery.working() as folder, ThreadPoolExecutor(1) as thread:
        (folder / "block").write_bytes(b"refined")
        with bucket_server.away():
            delivering = thread.submit(delivery.deliver, folder / "block")
            with pytest.raises(TimeoutError):
                delivering.result(timeout=1.0)
        file = delivering.result(timeout=120.0)
        assert isinstance(file, Delivered)
        delivery.conclude("block", [file])
    assert delivery.concluded("block") == [file]
