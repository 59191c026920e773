"""What a worker process does before its first job. Imports nothing heavy."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing import connection

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "MAGIC_THREADS",
)


def prepare_worker(threads: int, niceness: int) -> None:
    """Limit threads, yield to the server, and end with it, however it ends."""
    for variable in _THREAD_VARIABLES:
        os.environ[variable] = str(threads)
    os.nice(niceness)
    # Ctrl-C goes to the whole group; the server decides when its workers end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        watcher = threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True)
        watcher.start()


def _end_with(sentinel: int) -> None:
    """A killed parent closes no queue, so that its workers would wait for ever."""
    connection.wait([sentinel])
    os._exit(1)
