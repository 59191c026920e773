"""What a worker process does before its first job and around each. Imports nothing heavy."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any, Generic, TypeVar

from magic_core import tracing
from magic_core.tracing import TracingConfig

T = TypeVar("T")

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "MAGIC_THREADS",
)


@dataclass(frozen=True, slots=True)
class JobDone(Generic[T]):
    """What a job made, and how long it took."""

    result: T
    seconds: float


def run_job(parent: str | None, function: Callable[..., T], *arguments: Any) -> JobDone[T]:
    """Run a job as part of the trace that `parent`, a traceparent, names."""
    begun = time.perf_counter()
    with tracing.span(f"worker {function.__name__}", parent=parent):
        result = function(*arguments)
    return JobDone(result, time.perf_counter() - begun)


def prepare_worker(threads: int, niceness: int, trace: TracingConfig) -> None:
    """Limit threads, yield to the server, and end with it, however it ends."""
    for variable in _THREAD_VARIABLES:
        os.environ[variable] = str(threads)
    os.nice(niceness)
    # Ctrl-C goes to the whole group; the server decides when its workers end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tracing.configure(trace, service="magic-worker")
    parent = multiprocessing.parent_process()
    if parent is not None:
        watcher = threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True)
        watcher.start()


def _end_with(sentinel: int) -> None:
    """A killed parent closes no queue, so that its workers would wait for ever."""
    connection.wait([sentinel])
    os._exit(1)
