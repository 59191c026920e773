"""Jobs and their results as bytes, with paths that hold on every machine.

A path under the server's data folder is written down relative to it and read as a path under the
folder where the other machine has it. Bytes are pickles: they come from and go to machines of one
cluster, which trust each other, since each runs what the other sends (docs/cluster.md).
"""

from __future__ import annotations

import io
import os
import pickle
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from magic_core.errors import MagicError
from magic_server.jobs.worker import JobDone, run_job


@dataclass(frozen=True, slots=True)
class SealedJob:
    """A job on its way to a worker."""

    parent: str | None
    """The traceparent that it belongs to."""
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class JobFailed:
    """The error that a job raised."""

    error: Exception
    traceback: str


def seal(value: object, root: Path) -> bytes:
    """A value as bytes; `root` is the data folder here."""
    buffer = io.BytesIO()
    _Sealer(buffer, root).dump(value)
    return buffer.getvalue()


def unseal(data: bytes, root: Path) -> Any:
    """The value that `seal` made bytes of; `root` is the data folder here."""
    return _Unsealer(io.BytesIO(data), root).load()


def run_sealed_job(message: bytes, root: str) -> bytes:
    """Run a SealedJob in this process; gives a JobDone or a JobFailed, sealed."""
    folder = Path(root)
    try:
        job: SealedJob = unseal(message, folder)
        done: JobDone[Any] = run_job(job.parent, job.function, *job.arguments)
        return seal(done, folder)
    except Exception as error:
        return seal_failure(error, folder)


def seal_failure(error: Exception, root: Path) -> bytes:
    """An error as bytes; one that does not survive the way keeps its words."""
    text = "".join(traceback.format_exception(error))
    try:
        data = seal(JobFailed(error, text), root)
        unseal(data, root)
    except Exception:
        return seal(JobFailed(MagicError(f"{type(error).__name__}: {error}"), text), root)
    return data


class _Sealer(pickle.Pickler):
    def __init__(self, file: io.BytesIO, root: Path) -> None:
        super().__init__(file, protocol=5)
        self._root = os.path.abspath(root)

    def persistent_id(self, obj: Any) -> str | None:
        if not isinstance(obj, PurePath):
            return None
        place = PurePath(os.path.abspath(obj))
        return (
            place.relative_to(self._root).as_posix() if place.is_relative_to(self._root) else None
        )


class _Unsealer(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, root: Path) -> None:
        super().__init__(file)
        self._root = root

    def persistent_load(self, pid: str) -> Path:
        return self._root / pid
