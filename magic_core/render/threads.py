"""Our own threads for nogil kernels: safe for concurrent callers, and after a fork.

numba's workqueue layer aborts when two threads call it at once, and libgomp spins and dies after
a fork. Here a kernel is an ordinary function that claims pieces of work from an atomic counter
until none is left; the caller runs it itself while helper threads join in. A helper that comes
late finds the job closed and leaves, so nobody ever waits for a thread that has not started, and
any number of callers may share the helpers.
"""

from __future__ import annotations

import math
import os
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import TextIO

import numpy as np

from magic_core.errors import ConfigError

try:
    import fcntl
except ImportError:  # no file locks on this system: every process counts itself alone
    fcntl = None


_SHARE_LASTS_S = 2.0


def default_threads() -> int:
    """`MAGIC_THREADS`, else this process's fair share of the cores it may use.

    The share is counted anew every two seconds: when several agents render on one machine, each
    takes its part of the cores, and the last one left has them all.
    """
    setting = os.environ.get("MAGIC_THREADS")
    if setting is not None:
        if not setting.isdecimal() or int(setting) < 1:
            raise ConfigError.field("MAGIC_THREADS", f"{setting!r}: expected a whole number >= 1")
        return int(setting)
    if time.monotonic() - _share.counted_at > _SHARE_LASTS_S:
        _share.threads = max(1, available_cores() // rendering_processes())
        _share.counted_at = time.monotonic()
    return _share.threads


def available_cores() -> int:
    """The number of cores that the operating system lets this process run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def rendering_processes() -> int:
    """How many processes of this user render on this machine now, this one included.

    Each holds a lock on a file of its own, which the system releases however the process ends.
    """
    if fcntl is None:
        return 1
    try:
        folder = _registry_folder()
        if _share.lock is None:
            _share.lock = open(folder / str(os.getpid()), "w")  # noqa: SIM115 - held until the end
            fcntl.flock(_share.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return max(1, sum(_is_held(path) for path in folder.iterdir()))
    except OSError:
        return 1


def _registry_folder() -> Path:
    folder = Path(tempfile.gettempdir()) / f"magic-slam-{os.getuid()}" / "rendering"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _is_held(path: Path) -> bool:
    """Whether a living process holds the file's lock; files of ended ones are removed."""
    assert fcntl is not None
    with open(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
    path.unlink(missing_ok=True)
    return False


class _Share:
    """What this process knows of its share."""

    def __init__(self) -> None:
        self.threads = 1
        self.counted_at = -math.inf
        self.lock: TextIO | None = None


_share = _Share()


class _Job:
    """One kernel call that several threads work on together."""

    def __init__(self, kernel: Callable, arguments: tuple) -> None:
        self._kernel = kernel
        self._arguments = (np.zeros(1, np.int64), *arguments)  # the counter of claimed pieces
        self._lock = threading.Lock()
        self._finished = threading.Lock()
        self._helping = 0
        self._closed = False
        self._error: BaseException | None = None

    def help(self) -> None:
        """Join in, unless the caller has already finished all pieces."""
        with self._lock:
            if self._closed:
                return
            self._helping += 1
        try:
            self._kernel(*self._arguments)
        except BaseException as error:  # raised again in the caller
            self._error = error
        with self._lock:
            self._helping -= 1
            if self._closed and self._helping == 0:
                self._finished.release()

    def run(self) -> None:
        """Do the caller's share, then wait for the helpers that have begun."""
        self._finished.acquire()
        try:
            self._kernel(*self._arguments)
        finally:
            with self._lock:
                self._closed = True
                waiting = self._helping > 0
            if waiting:
                self._finished.acquire()
        if self._error is not None:
            raise self._error


class _Helpers:
    """The daemon threads of this process; they start when first needed."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._count = 0
        self._lock = threading.Lock()

    def offer(self, job: _Job, helpers: int) -> None:
        """Ask `helpers` threads to join the job."""
        if self._count < helpers:
            self._start(helpers)
        for _ in range(helpers):
            self._jobs.put(job)

    def _start(self, wanted: int) -> None:
        with self._lock:
            while self._count < wanted:
                name = f"magic-render-{self._count}"
                threading.Thread(target=self._work, name=name, daemon=True).start()
                self._count += 1

    def _work(self) -> None:
        while True:
            self._jobs.get().help()


_helpers = _Helpers()


def _begin_afresh() -> None:
    """In a forked child the parent's threads do not exist, and its lock is not the child's."""
    global _helpers, _share
    _helpers, _share = _Helpers(), _Share()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_afresh)


def run(kernel: Callable, arguments: tuple, *, threads: int) -> None:
    """Call kernel(claimed, *arguments) in up to `threads` threads at once and wait for the end.

    `claimed` is an int64 array of one zero; the kernel takes its pieces with `simd.claim`.
    """
    if threads <= 1:
        kernel(np.zeros(1, np.int64), *arguments)
        return
    job = _Job(kernel, arguments)
    _helpers.offer(job, threads - 1)
    job.run()
