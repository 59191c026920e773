"""Whether a bucket can be used as `magic serve` and `magic worker` use it, from this machine."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from magic_cli.machine import Check
from magic_core.errors import MagicError
from magic_server.store_config import StoreConfig

_BYTES = 1 << 20


def bucket(config: StoreConfig) -> Check:
    """Write, read and delete a blob in the bucket of a configuration."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            seconds = _round_trip(config, Path(folder))
        except MagicError as error:
            return Check("bucket", "fail", error.message, "docs/cluster.md lists what helps")
    return Check("bucket", "ok", f"{config.blobs}: 1 MiB there and back in {seconds * 1e3:.0f} ms")


def _round_trip(config: StoreConfig, folder: Path) -> float:
    from magic_server.store.bucket import BucketBlobs, bucket_of

    place = bucket_of(config, folder)
    assert place is not None  # who asks names one
    blobs = BucketBlobs(place, server=f"doctor-{os.urandom(4).hex()}")
    blobs.open()
    begun = time.perf_counter()
    blob = blobs.writer()
    try:
        blob.write(os.urandom(_BYTES))
        blob.finish()
        blob.content()
    finally:
        blob.discard()
    return time.perf_counter() - begun
