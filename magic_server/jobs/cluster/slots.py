"""What runs on a Dask worker: each job in a process of its own, which ends with it if need be.

The worker's own process only talks: a job that computes for minutes without letting go of the
interpreter would keep it from answering, and one that crashes would take it along.
"""

from __future__ import annotations

import asyncio
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from magic_core.errors import Unavailable
from magic_core.tracing import TracingConfig
from magic_server.jobs.config import JobConfig
from magic_server.jobs.executor import ProcessExecutor
from magic_server.jobs.sealing import run_sealed_job, seal_failure

if TYPE_CHECKING:
    from distributed import Worker

logger = logging.getLogger(__name__)

CANCEL_POLL_S = 0.2
"""How often a job that runs is looked up: is it still wanted?"""
_RUNNING = ("executing", "resumed", "long-running")
_ATTRIBUTE = "magic_slots"


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """How a worker runs its jobs."""

    data_dir: Path | None = None
    """Where the server's data folder is here; None where it is under the same path as there. Where
    blobs are in a bucket, any folder: for what jobs read and make."""
    threads: int = 1
    """Threads of the numerical libraries in each job."""
    niceness: int = 5
    """Added to the jobs' niceness, so that the worker itself always answers."""
    tracing: TracingConfig = field(default_factory=TracingConfig)


class JobSlots:
    """The processes of one worker; there are as many as jobs ran at once."""

    def __init__(self, settings: WorkerSettings = WorkerSettings()) -> None:
        self._settings = settings
        self._idle: list[ProcessExecutor] = []
        self._own: tempfile.TemporaryDirectory[str] | None = None

    def root(self, folder: str) -> Path:
        """Where a server's data folder is here; a folder of this worker's own where no path says
        which is shared."""
        if self._settings.data_dir or folder:
            return self._settings.data_dir or Path(folder)
        if self._own is None:
            self._own = tempfile.TemporaryDirectory(prefix="magic-worker-")
        return Path(self._own.name)

    async def run(
        self, message: bytes, root: Path, *, job: str, wanted: Callable[[], bool]
    ) -> bytes:
        """Run a sealed job; a job that is no longer wanted is ended with its process.

        `job` is what it is called.
        """
        process = self._idle.pop() if self._idle else self._new_process()
        work = asyncio.create_task(process.run(run_sealed_job, message, str(root)))
        try:
            while wanted():
                done, _ = await asyncio.wait([work], timeout=CANCEL_POLL_S)
                if done:
                    return _outcome(job, work, root)
            raise asyncio.CancelledError("nobody wants this job any more")
        finally:
            if work.done():
                self._idle.append(process)
            else:
                work.cancel()
                await asyncio.shield(process.close())

    async def close(self) -> None:
        """End the processes that have nothing to do; the others end with their jobs."""
        while self._idle:
            await self._idle.pop().close()
        if self._own is not None:
            self._own.cleanup()
            self._own = None

    def _new_process(self) -> ProcessExecutor:
        settings = self._settings
        config = JobConfig(
            workers=1, threads_per_worker=settings.threads, niceness=settings.niceness
        )
        return ProcessExecutor(config, trace=settings.tracing)


def provide(worker: Worker, slots: JobSlots) -> None:
    """Let a Dask worker run its jobs in these slots."""
    setattr(worker, _ATTRIBUTE, slots)


def slots_of(worker: Worker) -> JobSlots:
    """The slots of a Dask worker; those of a plain `dask worker` are made at its first job."""
    if not hasattr(worker, _ATTRIBUTE):
        provide(worker, JobSlots())
    return getattr(worker, _ATTRIBUTE)


async def run_sealed(key: str, folder: str, message: bytes) -> bytes:
    """The one Dask task there is: run a sealed job on this worker.

    `key` is its own key, `folder` the path of the server's data folder on the server, empty where
    that is not shared.
    """
    from distributed import get_worker

    worker = get_worker()
    slots = slots_of(worker)

    def wanted() -> bool:
        task = worker.state.tasks.get(key)
        return task is not None and task.state in _RUNNING

    job = key.rpartition("-")[0]
    return await slots.run(message, slots.root(folder), job=job, wanted=wanted)


def _outcome(job: str, work: asyncio.Task[bytes], root: Path) -> bytes:
    try:
        return work.result()
    except Unavailable:
        logger.warning("the processes of %s died twice; it is given up", job)
        return seal_failure(Unavailable(f"workers died twice during {job}"), root)
