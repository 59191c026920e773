"""Which workers a server gives jobs to: those that are like it and reach its blobs.

A server marks its data folder with an id. Each worker that joins the cluster is asked, by this
module running there, whether it finds that mark or, where blobs are in a bucket, whether the bucket
lets it in; if so it offers the resource `store-<id>`, which every job of the server demands. A
worker that cannot do the work is thus never given any.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import platform
import socket
import uuid
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from magic_core.errors import MagicError
from magic_server.jobs.cluster.slots import slots_of
from magic_server.store.bucket_client import BucketPlace, client_of, look

if TYPE_CHECKING:
    from distributed import Worker

ID_FILE = "cluster-id"


@dataclass(frozen=True, slots=True)
class ServedStore:
    """What workers must reach to work for a server."""

    id: str
    folder: str
    """Path of its data folder, on the server."""
    bucket: BucketPlace | None
    """Where its blobs are, None where they are in that folder."""

    @property
    def shared_folder(self) -> str:
        """The folder that workers share; empty where they share the bucket alone."""
        return "" if self.bucket else self.folder


def versions() -> tuple[str, str]:
    """Of this project and of Python, as far as both ends of a job must agree."""
    return version("magic-slam"), ".".join(platform.python_version_tuple()[:2])


def mark(folder: Path) -> str:
    """The id of a data folder, which is given one where it has none."""
    place = folder / ID_FILE
    if not place.exists():
        partial = folder / f"{ID_FILE}.{uuid.uuid4().hex}.partial"
        partial.write_text(uuid.uuid4().hex)
        # A link, since another server of the same folder may do this too: the first one stays.
        with contextlib.suppress(FileExistsError):
            os.link(partial, place)
        partial.unlink()
    return place.read_text().strip()


def resource_of(store: str) -> str:
    """The name of the resource that workers offer which see a data folder."""
    return f"store-{store}"


async def admit(
    store: ServedStore, expected: tuple[str, str], *, dask_worker: Worker
) -> str | None:
    """Let a worker offer its service to a server, or say why it does not. Runs on the worker."""
    slots = slots_of(dask_worker)
    root = slots.root(store.shared_folder)
    refusal = await asyncio.to_thread(_refusal, store, root, expected)
    if refusal is None:
        await dask_worker.set_resources(
            **{resource_of(store.id): float(dask_worker.state.nthreads)}
        )
    return refusal


def _refusal(store: ServedStore, root: Path, expected: tuple[str, str]) -> str | None:
    here = socket.gethostname()
    if versions() != expected:
        own, wanted = (f"magic-slam {m} on Python {p}" for m, p in (versions(), expected))
        return f"{here} has {own}, the server {wanted}; install the same on both"
    if store.bucket is not None:
        return _refusal_of_bucket(store.bucket, here)
    remedy = "mount the server's data folder there, and give magic worker --data-dir where it is"
    try:
        found = (root / ID_FILE).read_text().strip()
    except OSError as error:
        return (
            f"{here} does not see the server's data folder at {root} ({error.strerror}); {remedy}"
        )
    if found != store.id:
        return f"{root} on {here} is the data folder of another server; {remedy}"
    if not os.access(root, os.W_OK):
        return f"{root} on {here} cannot be written; mount it so that its user may write"
    return None


def _refusal_of_bucket(place: BucketPlace, here: str) -> str | None:
    try:
        look(client_of(place))
    except MagicError as error:
        return f"{here}: {error.message}"
    return None
