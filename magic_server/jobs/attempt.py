"""Jobs that write files, so that a second try and what is left of the first do no harm.

A job is tried again when its worker is lost. That worker may only be cut off, and write on for a
moment: the later try wins, and every file is whole at every instant.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from magic_core.errors import WrongState

_PROGRESS_INTERVAL_S = 0.2


class Attempt:
    """One try at a job that works in a folder and reports how far it is."""

    def __init__(self, folder: Path) -> None:
        """Take the folder over from any earlier try."""
        folder.mkdir(parents=True, exist_ok=True)
        self._mark, self._progress = folder / "attempt", folder / "progress.json"
        self._id = uuid.uuid4().hex
        self._reported = -1.0
        self._replace(self._mark, self._id)

    def report(self, share: float, stage: str) -> None:
        """Say how far the job is, a few times a second at most.

        WrongState where a later try has taken the folder over.
        """
        if time.monotonic() - self._reported < _PROGRESS_INTERVAL_S and 0.0 < share < 1.0:
            return
        self._reported = time.monotonic()
        self._require_newest()
        self._replace(self._progress, json.dumps([share, stage]))

    @contextlib.contextmanager
    def file(self, path: Path) -> Iterator[Path]:
        """A new file to write, which is `path` once the block ends."""
        partial = path.with_name(f"{path.name}.{self._id}.partial")
        yield partial
        self._require_newest()
        partial.replace(path)

    def _require_newest(self) -> None:
        if self._mark.read_text() != self._id:
            raise WrongState("this job was begun again elsewhere; that try goes on")

    def _replace(self, path: Path, text: str) -> None:
        partial = path.with_name(f"{path.name}.{self._id}.partial")
        partial.write_text(text)
        partial.replace(path)


@contextlib.contextmanager
def made_whole(folder: Path) -> Iterator[Path]:
    """A new folder to fill, which is `folder` once the block ends.

    Where another try at the same job made it meanwhile, that one stays: it holds the same.
    """
    partial = folder.with_name(f"{folder.name}.{uuid.uuid4().hex}.partial")
    partial.mkdir(parents=True)
    try:
        yield partial
        with contextlib.suppress(OSError):
            partial.rename(folder)
        if not folder.is_dir():
            raise OSError(f"{folder} could not be made from {partial}")
    finally:
        shutil.rmtree(partial, ignore_errors=True)
