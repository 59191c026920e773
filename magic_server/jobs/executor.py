"""The default engine: a pool of spawned processes on this machine."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from magic_core import tracing
from magic_core.errors import Unavailable
from magic_core.tracing import TracingConfig
from magic_server.jobs.config import JobConfig
from magic_server.jobs.counted import CountedJobs
from magic_server.jobs.protocol import JobObserver
from magic_server.jobs.worker import JobDone, prepare_worker, run_job

logger = logging.getLogger(__name__)
T = TypeVar("T")


class ProcessExecutor(CountedJobs):
    """Jobs in spawned processes on this machine; a job whose worker dies is tried once more."""

    def __init__(
        self,
        config: JobConfig | None = None,
        *,
        trace: TracingConfig | None = None,
        observer: JobObserver = lambda job, outcome, waited_s, ran_s: None,
    ) -> None:
        super().__init__()
        self._config = config or JobConfig()
        self._trace = trace or TracingConfig()
        self._observer = observer
        self._pool = self._new_pool()
        self._lock = threading.Lock()
        self._closed = False

    @property
    def workers(self) -> int:
        """How many jobs run at once."""
        return self._config.workers

    @property
    def slots(self) -> int:
        """How many jobs could run at once now."""
        return self._config.workers

    @property
    def shares_folder(self) -> bool:
        """Its processes run on the server's machine."""
        return True

    async def start(self) -> None:
        """Nothing: processes start with the first jobs."""

    async def _run(self, name: str, function: Callable[..., T], *arguments: Any) -> T:
        parent = tracing.traceparent()
        for last in (False, True):
            pool = self._pool
            begun = time.perf_counter()
            try:
                done: JobDone[T] = await self._done(pool, run_job, parent, function, *arguments)
                waited_s = time.perf_counter() - begun - done.seconds
                self._observer(name, "ok", max(0.0, waited_s), done.seconds)
                return done.result
            except BrokenProcessPool:
                self._replace(pool)
                logger.warning("a worker died during %s", name)
                self._observer(name, "died", 0.0, 0.0)
                if last:
                    raise Unavailable(f"workers died twice during {name}") from None
            except Exception:
                self._observer(name, "failed", 0.0, 0.0)
                raise
        raise AssertionError("unreachable")

    async def _done(self, pool: ProcessPoolExecutor, *call: Any) -> Any:
        """What a worker answers; Unavailable when the pool ends first, however that shows."""
        try:
            # Submitting may start a process, which takes longer than the event loop can spare.
            future = await asyncio.to_thread(_submitted, pool, *call)
            return await asyncio.wrap_future(future)
        except (BrokenProcessPool, _PoolEnded) as error:
            if not self._closed:
                raise
            raise Unavailable("the server is stopping") from error
        except asyncio.CancelledError as error:  # of the job where it was still waiting
            task = asyncio.current_task()
            if not self._closed or task is None or task.cancelling():
                raise
            raise Unavailable("the server is stopping") from error

    async def close(self) -> None:
        """End the workers; jobs under way are lost."""
        self._closed = True
        await asyncio.to_thread(_end, self._pool)

    def _new_pool(self) -> ProcessPoolExecutor:
        config = self._config
        return ProcessPoolExecutor(
            config.workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=prepare_worker,
            initargs=(config.threads_per_worker, config.niceness, self._trace),
        )

    def _replace(self, broken: ProcessPoolExecutor) -> None:
        with self._lock:
            if self._pool is broken:
                self._pool = self._new_pool()
        broken.shutdown(wait=False)


class _PoolEnded(Exception):
    """A pool was shut down before it took a job."""


def _submitted(pool: ProcessPoolExecutor, *call: Any) -> Future[Any]:
    try:
        return pool.submit(*call)
    except BrokenProcessPool:
        raise
    except RuntimeError as error:
        raise _PoolEnded from error


def _end(pool: ProcessPoolExecutor) -> None:
    """Stop a pool without waiting for jobs that may take minutes."""
    # The pool offers no way to end running jobs before Python 3.14 (terminate_workers).
    workers = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for worker in workers:
        worker.terminate()
    for worker in workers:
        worker.join(timeout=5.0)
