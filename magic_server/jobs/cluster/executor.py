"""The engine for more than one machine: jobs on the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

from magic_core import tracing
from magic_core.errors import Unavailable
from magic_server.jobs.cluster.admission import ServedStore, mark
from magic_server.jobs.cluster.dispatch import Dispatch
from magic_server.jobs.cluster.library import require_distributed, security_of
from magic_server.jobs.config import JobConfig
from magic_server.jobs.counted import CountedJobs
from magic_server.jobs.kinds import kind_of
from magic_server.jobs.protocol import JobObserver
from magic_server.jobs.sealing import JobFailed, SealedJob, seal, unseal
from magic_server.jobs.worker import JobDone
from magic_server.store.bucket_client import BucketPlace

logger = logging.getLogger(__name__)
T = TypeVar("T")


class DaskExecutor(CountedJobs):
    """Jobs wherever a `magic worker` is connected to the scheduler and reaches the blobs."""

    def __init__(
        self,
        config: JobConfig,
        *,
        folder: Path,
        bucket: BucketPlace | None = None,
        observer: JobObserver = lambda job, outcome, waited_s, ran_s: None,
    ) -> None:
        """Raises ConfigError without Dask or with certificates that cannot be used."""
        super().__init__()
        require_distributed(field="jobs.executor")
        self._security = security_of(config.tls, field="jobs.tls")
        self._config = config
        self._folder = folder
        self._bucket = bucket
        self._observer = observer
        # Dask has a loop of its own: large messages and its bookkeeping hold up no call.
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run_loop, name="magic-dask", daemon=True)
        self._dispatch: Dispatch | None = None
        self._keeping: Any = None

    @property
    def workers(self) -> int:
        """How many jobs a caller that has many should have open at a time."""
        return self._config.in_flight

    @property
    def slots(self) -> int:
        """How many jobs could run at once now."""
        return 0 if self._dispatch is None else self._dispatch.slots

    @property
    def shares_folder(self) -> bool:
        """Where blobs are in a bucket, workers need nothing else of the server's."""
        return self._bucket is None

    async def start(self) -> None:
        """Begin to connect; a scheduler that is away is waited for, which the log says."""
        store = await asyncio.to_thread(mark, self._folder)
        self._thread.start()
        self._dispatch = Dispatch(
            self._config,
            store=ServedStore(store, str(self._folder.absolute()), self._bucket),
            security=self._security,
        )
        self._keeping = self._over_there(self._dispatch.keep_connected())

    async def close(self) -> None:
        """Leave the cluster; its workers end what they run for this server."""
        if self._dispatch is None:
            self._loop.close()
            return
        self._loop.call_soon_threadsafe(self._dispatch.stop)
        self._keeping.cancel()
        await asyncio.wrap_future(self._over_there(_all_done()))
        self._loop.call_soon_threadsafe(self._loop.stop)
        await asyncio.to_thread(self._thread.join)
        self._loop.close()
        self._dispatch = None

    async def _run(self, name: str, function: Callable[..., T], *arguments: Any) -> T:
        if self._dispatch is None:
            raise Unavailable("the server is stopping")
        begun = time.perf_counter()
        job = SealedJob(tracing.traceparent(), function, arguments)
        try:
            message = await asyncio.to_thread(seal, job, self._folder)
            work = self._dispatch.run(name, kind_of(name), message)
            sealed = await asyncio.wrap_future(self._over_there(work))
            outcome: JobDone[T] | JobFailed = await asyncio.to_thread(unseal, sealed, self._folder)
        except Unavailable:
            self._observer(name, "died", 0.0, 0.0)
            raise
        if isinstance(outcome, JobFailed):
            self._observer(name, "failed", 0.0, 0.0)
            raise outcome.error from _RemoteTraceback(outcome.traceback)
        waited_s = time.perf_counter() - begun - outcome.seconds
        self._observer(name, "ok", max(0.0, waited_s), outcome.seconds)
        return outcome.result

    def _over_there(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def _run_loop(self) -> None:
        asyncio.set_event_loop(self._loop)
        # Dask leaves timeouts behind that nobody waits for; what matters is raised in a task.
        self._loop.set_exception_handler(lambda _, context: logger.debug("%s", context))
        self._loop.run_forever()


class _RemoteTraceback(Exception):
    """Where in the worker an error was raised."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


async def _all_done() -> None:
    """Wait until the other tasks of this loop have ended, those of Dask a bounded time."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    if others:
        await asyncio.wait(others, timeout=5.0)
