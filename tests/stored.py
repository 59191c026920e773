"""What a server has stored, wherever its configuration puts it."""

from __future__ import annotations

from pathlib import Path

from magic_server.config import ServerConfig
from magic_server.store import SessionRow, Store, Vertex
from magic_server.store.bucket import BucketBlobs, bucket_of, listed
from magic_server.store.bucket_client import BucketClient

OTHERS = ("database-id", "/previews/", "/merge-", "/excerpts/")
"""Objects of a bucket that are no blobs of a session."""


def stored_files(config: ServerConfig) -> list[str]:
    """The names of all blobs, those on their way in included."""
    place = bucket_of(config.store, config.data_dir)
    if place is None:
        folders = [config.data_dir / "blobs", *config.data_dir.glob("**/incoming")]
        found = [file for folder in folders for file in folder.rglob("*") if file.is_file()]
        return sorted(file.name for file in found)
    files = listed(BucketClient(place), "")
    kept = [key for key, _ in files if not any(other in key for other in OTHERS)]
    return sorted(Path(key).name for key in kept)


def stored_previews(config: ServerConfig) -> int:
    """How many previews there are, of any session."""
    place = bucket_of(config.store, config.data_dir)
    if place is None:
        return len(list(config.data_dir.glob("**/previews/*/*")))
    keys = [key for key, _ in listed(BucketClient(place), "") if "/previews/" in key]
    return len({key.rpartition("/")[0] for key in keys})


async def stored_vertices(store: Store, session: SessionRow) -> list[Vertex]:
    """Every sub-map of a session, in order of arrival."""
    return [vertex async for page in store.submaps.pages(session) for vertex in page]


def put_stray(blobs, sha256: str, data: bytes) -> None:
    """Leave a blob that nothing refers to."""
    if isinstance(blobs, BucketBlobs):
        path = blobs.place.path(f"blobs/{sha256[0]}/{sha256}")
        BucketClient(blobs.place).files.pipe_file(path, data)
    else:
        blobs.path(sha256).write_bytes(data)
