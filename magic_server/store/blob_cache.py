"""A bounded folder of blobs that were read from far away, shared by the processes of a machine."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

_SLACK = 64
"""A process looks at the folder's size whenever it has added this fraction of the bound."""
_KEPT = 0.9


class BlobCache:
    """Blobs by digest; those that were not read for longest go first."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        """The folder holds at most `max_bytes`, and 1/64 of that for each process that reads."""
        self._folder = folder
        self._max_bytes = max_bytes
        self._unseen = max_bytes  # what others have left is counted at the first blob
        if max_bytes:
            folder.mkdir(parents=True, exist_ok=True)

    def get(self, sha256: str) -> bytes | None:
        """A blob's bytes, checked; None where it is not here, or not what it was."""
        path = self._folder / sha256
        try:
            data = path.read_bytes()
            os.utime(path)
        except OSError:
            return None
        if hashlib.sha256(data).hexdigest() == sha256:
            return data
        path.unlink(missing_ok=True)
        return None

    def put(self, sha256: str, data: bytes) -> None:
        """Keep a checked blob. A disk that has no room for it is no error."""
        if len(data) > self._max_bytes // _SLACK:
            return  # it would push too many others out
        with contextlib.suppress(OSError):
            self._write(sha256, data)
            self._unseen += len(data)
            if self._unseen >= self._max_bytes // _SLACK:
                self._unseen = 0
                self._trim()

    def _write(self, sha256: str, data: bytes) -> None:
        descriptor, partial = tempfile.mkstemp(dir=self._folder, suffix=".partial")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
            os.replace(partial, self._folder / sha256)
        except OSError:
            Path(partial).unlink(missing_ok=True)
            raise

    def _trim(self) -> None:
        with os.scandir(self._folder) as entries:
            found = sorted((s.st_mtime, s.st_size, e.path) for e in entries for s in [e.stat()])
        total = sum(size for _, size, _ in found)
        if total <= self._max_bytes:
            return
        for _, size, path in found:
            Path(path).unlink(missing_ok=True)
            total -= size
            if total <= _KEPT * self._max_bytes:
                return
