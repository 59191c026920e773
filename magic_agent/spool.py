"""The agent's spool: every finished sub-map lies on disk, encoded, until it is acknowledged.

One file per sub-map, `{index:06d}.submap`: the line `magicslam-submap-1`, the header's length as
a little-endian uint64, the header (a SubmapHeader message), then its blobs in order. Files appear
and disappear in one step, so an agent killed at any instant finds whole ones when it starts again.

The newest sub-map stays as `.sent` when it is acknowledged, and beside it `{index:06d}.state`
(see `resume`), which was there before it: together they are where a restarted agent goes on.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from magicslam.v1 import submap_pb2

from magic_agent import resume
from magic_agent.resume import ResumeState
from magic_core.errors import CorruptData, NotFound
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

    def newest(self) -> int | None:
        """Index of the last finished sub-map, sent or not; None without any."""
        found = [int(path.stem) for path in self.folder.glob("*.sent")]
        return max([*found, *self.pending()], default=None)

    def add(self, index: int, encoded: EncodedSubmap, *, state: ResumeState | None = None) -> None:
        """Store one sub-map; when this returns it survives a crash of the machine.

        `state` is where the agent goes on behind it.
        """
        if state is not None:
            # First: a sub-map without its state would be begun again, and differ from this one.
            self._write(self._path(index, "state"), [resume.encode(state)])
        header = encoded.header.SerializeToString()
        start = MAGIC + _LENGTH.pack(len(header)) + header
        self._write(self._path(index), [start, *encoded.blobs])
        self._drop_before(index)

    def load(self, index: int) -> EncodedSubmap:
        """Read one sub-map back, sent or not. Raises CorruptData naming a damaged file."""
        path = self._existing(index)
        data = path.read_bytes()
        header, end = _header(path, data)
        blobs = []
        for blob in header.blobs:
            blobs.append(data[end : end + blob.length])
            end += blob.length
        if end != len(data):
            raise CorruptData(f"{path}: {len(data)} bytes, expected {end}; it was cut short")
        return EncodedSubmap(header, tuple(blobs))

    def load_header(self, index: int) -> submap_pb2.SubmapHeader:
        """The header alone."""
        path = self._existing(index)
        return _header(path, path.read_bytes())[0]

    def load_state(self, index: int) -> ResumeState:
        """Where the agent goes on behind a sub-map. NotFound without it, CorruptData if damaged."""
        path = self._path(index, "state")
        try:
            return resume.decode(path.read_bytes())
        except FileNotFoundError:
            raise NotFound(f"{path} is missing") from None
        except (CorruptData, KeyError, ValueError) as error:
            raise CorruptData(f"{path}: {error}") from error

    def remove(self, index: int) -> None:
        """Take note of an acknowledgement; the newest sub-map stays to go on from."""
        path = self._path(index)
        if not path.exists():
            return
        if self.newest() == index:
            path.replace(self._path(index, "sent"))
        else:
            path.unlink()

    def clear(self) -> None:
        """Forget everything: the agent is finished, or starts over."""
        for kind in ("submap", "sent", "state"):
            for path in self.folder.glob(f"*.{kind}"):
                path.unlink()

    def _existing(self, index: int) -> Path:
        path = self._path(index)
        return path if path.exists() else self._path(index, "sent")

    def _path(self, index: int, kind: str = "submap") -> Path:
        return self.folder / f"{index:06d}.{kind}"

    def _drop_before(self, index: int) -> None:
        """Remove what a newer sub-map has made superfluous."""
        for kind in ("sent", "state"):
            for path in self.folder.glob(f"*.{kind}"):
                if int(path.stem) < index:
                    path.unlink()

    def _write(self, path: Path, pieces: Sequence[bytes]) -> None:
        """A file that appears in one step, on the disk."""
        partial = path.with_name(f".{path.name}.partial")
        with partial.open("wb") as file:
            file.writelines(pieces)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        self._sync_folder()

    def _sync_folder(self) -> None:
        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _header(path: Path, data: bytes) -> tuple[submap_pb2.SubmapHeader, int]:
    """A file's header and where its blobs begin."""
    start = len(MAGIC) + _LENGTH.size
    if not data.startswith(MAGIC) or len(data) < start:
        raise CorruptData(f"{path}: not a spooled sub-map; delete it to go on without it")
    end = start + _LENGTH.unpack_from(data, len(MAGIC))[0]
    return submap_pb2.SubmapHeader.FromString(data[start:end]), end
