"""The agent's spool: every finished sub-map lies on disk, encoded, until it is acknowledged.

One file per sub-map, `{index:06d}.submap`: the line `magicslam-submap-1`, the header's length as
a little-endian uint64, the header (a SubmapHeader message), then its blobs in order. Files appear
and disappear in one step, so an agent killed at any instant finds whole ones when it starts again.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

from magicslam.v1 import submap_pb2

from magic_core.errors import CorruptData
from magic_core.wire import EncodedSubmap

MAGIC = b"magicslam-submap-1\n"
_LENGTH = struct.Struct("<Q")


class Spool:
    """Unacknowledged sub-maps of one agent, oldest first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        for partial in folder.glob(".*.partial"):
            partial.unlink()

    def pending(self) -> list[int]:
        """Indices of the sub-maps that wait, in order."""
        return sorted(int(path.stem) for path in self.folder.glob("*.submap"))

    def add(self, index: int, encoded: EncodedSubmap) -> None:
        """Store one sub-map; when this returns it survives a crash of the machine."""
        header = encoded.header.SerializeToString()
        partial = self.folder / f".{index:06d}.partial"
        with partial.open("wb") as file:
            file.write(MAGIC + _LENGTH.pack(len(header)) + header)
            file.writelines(encoded.blobs)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(self._path(index))
        self._sync_folder()

    def load(self, index: int) -> EncodedSubmap:
        """Read one sub-map back. Raises CorruptData naming the file when it is damaged."""
        path = self._path(index)
        data = path.read_bytes()
        start = len(MAGIC) + _LENGTH.size
        if not data.startswith(MAGIC) or len(data) < start:
            raise CorruptData(f"{path}: not a spooled sub-map; delete it to go on without it")
        end = start + _LENGTH.unpack_from(data, len(MAGIC))[0]
        header = submap_pb2.SubmapHeader.FromString(data[start:end])
        blobs = []
        for blob in header.blobs:
            blobs.append(data[end : end + blob.length])
            end += blob.length
        if end != len(data):
            raise CorruptData(f"{path}: {len(data)} bytes, expected {end}; it was cut short")
        return EncodedSubmap(header, tuple(blobs))

    def remove(self, index: int) -> None:
        """Forget an acknowledged sub-map."""
        self._path(index).unlink(missing_ok=True)

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:06d}.submap"

    def _sync_folder(self) -> None:
        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
