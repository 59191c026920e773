"""A worker of a Dask cluster that does servers' jobs, and waits out a scheduler that is away."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from magic_server.jobs.cluster.library import require_distributed, security_of
from magic_server.jobs.cluster.slots import JobSlots, WorkerSettings, provide
from magic_server.jobs.config import ClusterTls

if TYPE_CHECKING:
    from distributed import Worker

logger = logging.getLogger(__name__)

RECONNECT_S = 2.0
CONNECT_TIMEOUT_S = 15.0
CLOSE_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class WorkerPlace:
    """Which scheduler a worker serves, and as what."""

    scheduler: str
    name: str
    processes: int
    """Jobs at a time."""
    resources: dict[str, float] = field(default_factory=dict)
    tls: ClusterTls = field(default_factory=ClusterTls)
    host: str | None = None
    """Address under which the scheduler reaches this worker; None lets the system choose."""
    port: int = 0


async def serve_jobs(
    place: WorkerPlace,
    settings: WorkerSettings,
    *,
    stop: asyncio.Event,
    on_ready: Callable[[str], None],
) -> None:
    """Work until told to stop; `on_ready` hears the worker's address whenever it has joined.

    Raises ConfigError without Dask or with certificates that cannot be used.
    """
    require_distributed(field="magic worker")
    security = security_of(place.tls, field="tls")
    with tempfile.TemporaryDirectory(prefix="magic-worker-") as scratch:
        while not stop.is_set():
            worker = _new_worker(place, security, scratch)
            slots = JobSlots(settings)
            provide(worker, slots)
            try:
                await _one_life(worker, stop, on_ready)
            except (OSError, TimeoutError, ValueError) as error:
                _complain(place, error)
            finally:
                # Not wait_for: it would wait for Dask to give in where the scheduler vanished too.
                closing = asyncio.ensure_future(worker.close(reason="magic worker"))
                closing.add_done_callback(lambda task: task.cancelled() or task.exception())
                await asyncio.wait([closing], timeout=CLOSE_TIMEOUT_S)
                await slots.close()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), RECONNECT_S)


async def _one_life(worker: Worker, stop: asyncio.Event, on_ready: Callable[[str], None]) -> None:
    """From joining the cluster to losing it or being told to stop."""
    await asyncio.wait_for(_until(worker.start(), stop), CONNECT_TIMEOUT_S)
    if stop.is_set():
        return
    on_ready(worker.address)
    await _until(worker.finished(), stop)
    if not stop.is_set():
        raise ConnectionError("the connection to the scheduler was lost")


async def _until(work, stop: asyncio.Event) -> None:
    """Wait for some work or for being told to stop, whichever comes first."""
    doing = asyncio.ensure_future(work)
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait([doing, stopping], return_when=asyncio.FIRST_COMPLETED)
        if doing.done():
            doing.result()
    finally:
        stopping.cancel()
        doing.cancel()


def _new_worker(place: WorkerPlace, security, scratch: str) -> Worker:
    from distributed import Worker

    return Worker(
        place.scheduler,
        nthreads=place.processes,
        name=place.name,
        resources=dict(place.resources),
        security=security,
        host=place.host,
        port=place.port,
        local_directory=scratch,
        # Jobs compute in processes of their own, whose memory Dask does not see.
        memory_limit=0,
        dashboard=False,
    )


def _complain(place: WorkerPlace, error: Exception) -> None:
    logger.warning(
        "not connected to the scheduler at %s: %s; trying again. Is it started there "
        "(dask scheduler), and is --name %s used once?",
        place.scheduler, str(error) or type(error).__name__, place.name,
    )  # fmt: skip
