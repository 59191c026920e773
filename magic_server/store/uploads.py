"""Uploads on their way in, on disk, so that one that breaks off is resumed where it was.

    uploads/{key}/upload.json   which sub-map by which request, the header's digest, blob lengths
    uploads/{key}/journal       length and CRC-32 of each chunk, two little-endian uint32 each
    uploads/{key}/{blob:05d}    the bytes of a blob

A server that is killed finds its uploads again. The journal says which bytes arrived and what they
were: what does not match it, after a loss of power say, is cut off and sent again. Every method
blocks, and one upload is used by one thread at a time: call them on a thread.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import struct
import threading
import zlib
from dataclasses import dataclass
from pathlib import Path

from magicslam.v1 import submap_pb2

from magic_core.errors import MagicError
from magic_core.wire import ChunkCursor
from magic_server.store.blobs import BlobWriter, sync_all, translated_disk_errors
from magic_server.upload_config import PartialUploadLimits

logger = logging.getLogger(__name__)

_RECORD = struct.Struct("<II")
_META, _JOURNAL = "upload.json", "journal"


@dataclass(frozen=True, slots=True)
class UploadName:
    """Which upload: a sub-map and the request that brings it."""

    submap: str
    """Resource name."""
    request_id: str

    @property
    def key(self) -> str:
        """Name of its folder."""
        return hashlib.sha256(f"{self.submap}\n{self.request_id}".encode()).hexdigest()[:40]

    @property
    def agent(self) -> str:
        """Resource name of the sub-map's agent."""
        return self.submap.rsplit("/submaps/", 1)[0]


class PartialUpload:
    """The blobs of one sub-map as far as they have come."""

    def __init__(
        self,
        folder: Path,
        name: UploadName,
        *,
        header_sha256: bytes,
        lengths: tuple[int, ...],
        sync_bytes: int,
    ) -> None:
        self.folder = folder
        self.name = name
        self.header_sha256 = header_sha256
        self.blobs: list[BlobWriter] = []
        self.cursor = ChunkCursor(lengths)
        self._lengths = lengths
        self._sync_bytes = sync_bytes
        self._unsynced = 0
        self._named = False  # whether the folder's own name is on the disk
        self._journal = (folder / _JOURNAL).open("ab")

    @property
    def held_bytes(self) -> int:
        """Bytes of all blobs so far."""
        return sum(blob.length for blob in self.blobs)

    def put(self, chunk: submap_pb2.BlobChunk) -> int | None:
        """Append a checked chunk; returns the blob that it completes. InvalidInput out of place."""
        index, offset = self.cursor.position
        complete = self.cursor.advance(chunk)
        if offset == 0:
            self.blobs.append(BlobWriter(self.folder, name=f"{index:05d}"))
        self.blobs[index].write(chunk.data)
        self.blobs[index].flush()
        with translated_disk_errors():
            self._journal.write(_RECORD.pack(len(chunk.data), chunk.crc32))
            self._journal.flush()
        self._unsynced += len(chunk.data)
        if complete:
            self.blobs[index].finish()
        if self._unsynced >= self._sync_bytes:
            self.sync()
        return index if complete else None

    def sync(self) -> None:
        """Everything that has come so far to the disk."""
        unsynced = [blob for blob in self.blobs if not blob.synced]
        sync_all([*(blob.path for blob in unsynced), *self._own_files()])
        sync_all([self.folder] if self._named else [self.folder, self.folder.parent])
        for blob in unsynced:
            blob.synced = True
        self._named = True
        self._unsynced = 0

    def _own_files(self) -> list[Path]:
        """What tells the next server of the blobs and is not on the disk."""
        journal, meta = self.folder / _JOURNAL, self.folder / _META
        return [journal] if self._named else [journal, meta]

    def pause(self) -> None:
        """Nobody sends at present: everything to the disk, no file stays open."""
        self.sync()
        self._journal.close()
        for blob in self.blobs:
            blob.close()

    def resume(self) -> None:
        """Open again what `pause` closed."""
        self._journal = (self.folder / _JOURNAL).open("ab")
        if not self.cursor.done and self.cursor.position[1]:
            self.blobs[-1].reopen()

    def discard(self) -> None:
        """Remove what the store has not adopted."""
        self._journal.close()
        for blob in self.blobs:
            blob.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def restore(self) -> None:
        """Take up what an earlier process left, as far as the journal confirms it."""
        journal = (self.folder / _JOURNAL).read_bytes()
        valid = 0
        for length, crc32 in _RECORD.iter_unpack(journal[: len(journal) // 8 * 8]):
            if not self._confirmed(length, crc32):
                break
            valid += _RECORD.size
        os.truncate(self.folder / _JOURNAL, valid)
        for blob in self.blobs:
            os.truncate(blob.path, blob.length)
        for stray in self.folder.glob("[0-9]*"):
            if int(stray.name) >= len(self.blobs):
                stray.unlink()
        self.pause()

    def _confirmed(self, length: int, crc32: int) -> bool:
        """Step over one chunk on disk; False when it is not there as the journal says."""
        if self.cursor.done:
            return False
        index, offset = self.cursor.position
        path = self.folder / f"{index:05d}"
        if not path.exists():
            return False
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(length)
        if not length or len(data) != length or zlib.crc32(data) != crc32:
            return False
        if offset == 0:
            self.blobs.append(BlobWriter(self.folder, name=path.name))
        chunk = submap_pb2.BlobChunk(blob_index=index, offset=offset, data=data)
        try:
            complete = self.cursor.advance(chunk)
        except MagicError:
            return False
        self.blobs[index].note(data)
        if complete:
            self.blobs[index].finish()
        return True


@dataclass(slots=True)
class _Kept:
    """An upload that nobody sends at present."""

    name: UploadName
    held_bytes: int
    paused_at: float
    upload: PartialUpload | None
    """None until it is asked for, after a restart."""


class UploadFolder:
    """Every upload that is under way or waits to be resumed."""

    def __init__(self, root: Path) -> None:
        self.folder = root / "uploads"
        self._kept: dict[str, _Kept] = {}
        # The event loop hands single uploads to threads; what is kept is shared by them.
        self._lock = threading.Lock()
        self.limits = PartialUploadLimits()

    def open(self, limits: PartialUploadLimits, *, now: float) -> None:
        """Find what an earlier process left; what is not whole enough to go on with is removed."""
        self.limits = limits
        self.folder.mkdir(parents=True, exist_ok=True)
        for folder in self.folder.iterdir():
            name = _name_in(folder)
            if name is None or name.key != folder.name or not (folder / "00000").exists():
                shutil.rmtree(folder, ignore_errors=True)
                continue
            held = sum(blob.stat().st_size for blob in folder.glob("[0-9]*"))
            at = max((folder / _JOURNAL).stat().st_mtime, folder.stat().st_mtime)
            self._kept[folder.name] = _Kept(name, held, min(at, now), None)
        self.prune(now=now)

    def begin(
        self, name: UploadName, header: submap_pb2.SubmapHeader, header_sha256: bytes
    ) -> PartialUpload:
        """A new upload, in place of what was kept under this name."""
        self.drop(name)
        folder = self.folder / name.key
        shutil.rmtree(folder, ignore_errors=True)
        lengths = tuple(blob.length for blob in header.blobs)
        meta = {
            "submap": name.submap,
            "request_id": name.request_id,
            "header_sha256": header_sha256.hex(),
            "lengths": lengths,
        }
        with translated_disk_errors():
            folder.mkdir()
            with (folder / _META).open("w") as file:
                json.dump(meta, file)
        return self._upload(folder, name, header_sha256, lengths)

    def take(self, name: UploadName) -> PartialUpload | None:
        """What is kept under this name, for the caller to go on with; None without any."""
        with self._lock:
            kept = self._kept.pop(name.key, None)
        if kept is None:
            return None
        try:
            upload = kept.upload or self._restored(kept)
            upload.resume()
        except (OSError, ValueError, KeyError) as error:
            logger.warning("%s: the part that was kept cannot be read: %s", name.submap, error)
            shutil.rmtree(self.folder / name.key, ignore_errors=True)
            return None
        return upload

    def look(self, name: UploadName, *, now: float) -> tuple[int, int, int]:
        """(blob, offset, bytes held): where the upload of this name goes on."""
        upload = self.take(name)
        if upload is None:
            return 0, 0, 0
        found = *upload.cursor.position, upload.held_bytes
        self.keep(upload, now=now)
        return found

    def keep(self, upload: PartialUpload, *, now: float) -> None:
        """Put an upload aside until it is resumed."""
        if not upload.held_bytes:
            upload.discard()
            return
        upload.pause()
        with self._lock:
            self._kept[upload.name.key] = _Kept(upload.name, upload.held_bytes, now, upload)
        self.prune(now=now)

    def drop(self, name: UploadName) -> None:
        """Forget what is kept under a name."""
        with self._lock:
            kept = self._kept.pop(name.key, None)
        if kept is not None:
            shutil.rmtree(self.folder / name.key, ignore_errors=True)

    def forget(self, beginning: str) -> None:
        """Drop what is kept of sub-maps whose resource names begin like this."""
        with self._lock:
            mine = [k.name for k in self._kept.values() if k.name.submap.startswith(beginning)]
        for name in mine:
            self.drop(name)

    def prune(self, *, now: float) -> int:
        """Drop what is too old, and the oldest of what is too much; returns how many."""
        dropped = 0
        for kept in self._superfluous(now):
            logger.info("%s: dropped %d bytes of an upload", kept.name.submap, kept.held_bytes)
            self.drop(kept.name)
            dropped += 1
        return dropped

    def kept(self) -> tuple[int, int]:
        """(number, bytes) of uploads that wait to be resumed."""
        with self._lock:
            return len(self._kept), sum(kept.held_bytes for kept in self._kept.values())

    def _superfluous(self, now: float) -> list[_Kept]:
        limits, found = self.limits, []
        count, total, per_agent = 0, 0, dict[str, int]()
        with self._lock:
            newest_first = sorted(self._kept.values(), key=lambda kept: -kept.paused_at)
        for kept in newest_first:
            mine = per_agent.get(kept.name.agent, 0) + 1
            if (
                now - kept.paused_at > limits.max_age_s
                or mine > limits.max_per_agent
                or count + 1 > limits.max_count
                or total + kept.held_bytes > limits.max_bytes
            ):
                found.append(kept)
                continue
            count, total = count + 1, total + kept.held_bytes
            per_agent[kept.name.agent] = mine
        return found

    def _restored(self, kept: _Kept) -> PartialUpload:
        folder = self.folder / kept.name.key
        meta = json.loads((folder / _META).read_text())
        digest, lengths = bytes.fromhex(meta["header_sha256"]), tuple(map(int, meta["lengths"]))
        upload = self._upload(folder, kept.name, digest, lengths)
        upload.restore()
        return upload

    def _upload(
        self, folder: Path, name: UploadName, header_sha256: bytes, lengths: tuple[int, ...]
    ) -> PartialUpload:
        return PartialUpload(
            folder,
            name,
            header_sha256=header_sha256,
            lengths=lengths,
            sync_bytes=self.limits.sync_bytes,
        )


def _name_in(folder: Path) -> UploadName | None:
    """The upload that a folder says it holds; None when it does not say."""
    try:
        meta = json.loads((folder / _META).read_text())
        return UploadName(str(meta["submap"]), str(meta["request_id"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
