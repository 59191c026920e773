"""Keeps the connection to a Dask scheduler and carries jobs through whatever happens to it.

A job is held here until its result is: one that was under way when the scheduler, its worker or the
way to them was lost is handed over again once they are back. What waits here is rebuilt from the
store by the next start of the server, so that nothing is lost with it either.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import uuid
from typing import TYPE_CHECKING, Any

from magic_core.errors import Unavailable
from magic_server.jobs.cluster.admission import ServedStore, versions
from magic_server.jobs.cluster.gate import PriorityGate
from magic_server.jobs.cluster.roster import Needs, Roster
from magic_server.jobs.cluster.slots import run_sealed
from magic_server.jobs.config import JobConfig, parse_resources
from magic_server.jobs.kinds import JobKind

if TYPE_CHECKING:
    from distributed import Client, Future, Security

logger = logging.getLogger(__name__)

LOOK_S = 1.0
"""How often the workers are looked at."""
RECONNECT_S = 1.0
AGAIN_S = 0.2
"""Pause before a job is handed over again."""
REMIND_S = 60.0
"""What is wrong is said again after this long."""
RETRY_AFTER_S = 5.0
MOST_TRIES = 4
"""Before a job that workers were lost with, or that they could not run, is given up. Dask's own
count of lost workers (`allowed-failures`, 3) comes before each."""
_NO_NEEDS: Needs = {}


class Flight:
    """A job that the scheduler has."""

    def __init__(self, future: Future) -> None:
        self.future = future
        self.missed = 0
        """How often in a row no worker had it."""
        self.lost = asyncio.Event()

    async def landed(self) -> bytes | None:
        """The sealed result, or None when it has to be handed over again."""
        result = asyncio.ensure_future(self.future.result())
        lost = asyncio.create_task(self.lost.wait())
        try:
            await asyncio.wait([result, lost], return_when=asyncio.FIRST_COMPLETED)
            return result.result() if result.done() else None
        finally:
            result.cancel()
            lost.cancel()


class Dispatch:
    """One server's jobs on one cluster; lives in an event loop of its own."""

    def __init__(self, config: JobConfig, *, store: ServedStore, security: Security | None) -> None:
        self._config = config
        self._folder = store.shared_folder
        self._security = security
        self._roster = Roster(config.scheduler, store)
        self._merging = parse_resources(config.merge_resources, field="jobs.merge_resources")
        # Jobs that wait for a special worker are counted apart, so that they hold up no others.
        self._gate = PriorityGate(config.in_flight)
        self._merge_gate = PriorityGate(config.in_flight)
        self._client: Client | None = None
        self._flights: dict[str, Flight] = {}
        self._looked = asyncio.Event()
        self._trouble: str | None = f"not connected to {config.scheduler} yet"
        self._closing = False

    @property
    def slots(self) -> int:
        """How many jobs could run at once now."""
        return self._roster.slots(_NO_NEEDS)

    async def keep_connected(self) -> None:
        """Connect, look after the workers, and connect again, for ever."""
        said, at = None, 0.0
        while True:
            try:
                await self._one_connection()
            except (OSError, TimeoutError) as error:
                self._trouble = self._no_scheduler(error)
            except Exception as error:
                logger.exception("talking to the scheduler at %s failed", self._config.scheduler)
                self._trouble = self._no_scheduler(error)
            if self._trouble != said or time.monotonic() - at > REMIND_S:
                said, at = self._trouble, time.monotonic()
                logger.warning("%s; jobs wait until then", said)
            self._tell()
            await asyncio.sleep(RECONNECT_S)

    async def run(self, job: str, kind: JobKind, message: bytes) -> bytes:
        """The sealed result of a sealed job.

        Raises Unavailable when the job cannot be run, or, for an impatient one, nobody is there.
        """
        special = self._merging if kind.refines else _NO_NEEDS
        if kind.patient:
            return await self._carried(job, kind, special, message)
        work = asyncio.create_task(self._carried(job, kind, special, message))
        nobody = asyncio.create_task(self._nobody_there(special))
        try:
            await asyncio.wait([work, nobody], return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                return work.result()
            trouble = self._trouble or self._roster.trouble(special)
            raise Unavailable(str(trouble), retry_after_s=RETRY_AFTER_S)
        finally:
            work.cancel()
            nobody.cancel()

    async def _carried(self, job: str, kind: JobKind, special: Needs, message: bytes) -> bytes:
        gate = self._merge_gate if special else self._gate
        failure = None
        for _ in range(MOST_TRIES):
            failure = None
            while failure is None:
                async with gate.turn(kind.priority, ahead=kind.ahead):
                    try:
                        result = await self._handed_over(job, kind, special, message)
                    except _GaveUp as error:
                        failure, result = error, None
                if result is not None:
                    return result
                if self._closing:
                    raise Unavailable("the server is stopping")
                await asyncio.sleep(AGAIN_S)
            logger.warning("%s: %s", job, failure)
        raise Unavailable(f"{job} could not be run by the cluster: {failure}")

    def stop(self) -> None:
        """Give up every job."""
        self._closing = True
        self._give_up_flights()
        for gate in (self._gate, self._merge_gate):
            gate.open()  # those who wait learn it as well

    async def _handed_over(
        self, job: str, kind: JobKind, special: Needs, message: bytes
    ) -> bytes | None:
        """One try; None where the scheduler or its workers lost it."""
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        client = self._client
        if client is None or client.status != "running" or self._closing:
            return None
        key = f"{job}-{uuid.uuid4().hex}"
        future = client.submit(
            run_sealed, key, self._folder, message, key=key, pure=False,
            priority=kind.priority, resources=self._roster.needs(special),
        )  # fmt: skip
        flight = self._flights[key] = Flight(future)
        try:
            return await flight.landed()
        except FutureCancelledError as error:
            logger.info("%s is handed over again: %s", job, error)
            return None
        except KilledWorker as error:
            raise _GaveUp(f"its workers were lost one after another: {error}") from error
        except (OSError, TimeoutError):  # the connection broke while the result was fetched
            return None
        except Exception as error:
            if client.status != "running":
                return None
            raise _GaveUp(f"{type(error).__name__}: {error}") from error
        finally:
            del self._flights[key]
            await _let_go(client, future)

    async def _one_connection(self) -> None:
        """Connect, and look after everything until the connection is lost, which it raises."""
        from distributed import Client

        client = Client(
            self._config.scheduler, asynchronous=True, timeout=self._config.connect_timeout_s,
            security=self._security, set_as_default=False, name="magic-server",
        )  # fmt: skip
        try:
            await client
            await self._require_like_scheduler(client)
            self._client = client
            logger.info("connected to the scheduler at %s", self._config.scheduler)
            while True:
                async with asyncio.timeout(self._config.connect_timeout_s + 10.0):
                    await self._look(client)
                await asyncio.sleep(LOOK_S)
        finally:
            self._client = None
            self._roster.clear()
            self._set_limits()
            self._give_up_flights()
            try:
                await _closed(client)
            except Exception:
                logger.debug("a lost connection did not close cleanly", exc_info=True)

    async def _require_like_scheduler(self, client: Client) -> None:
        try:
            found = await client.run_on_scheduler(versions)
        except Exception as error:
            raise ConnectionError(
                f"the scheduler there cannot load magic-slam ({error}); start it where "
                "magic-slam[cluster] of this server's version is installed"
            ) from error
        if found != versions():
            raise ConnectionError(
                f"the scheduler there has magic-slam {found[0]} on Python {found[1]}, this server "
                f"{versions()[0]} on {versions()[1]}; install the same on both"
            )

    async def _look(self, client: Client) -> None:
        if client.status != "running":
            raise ConnectionError("the connection was lost")
        await self._roster.look(client)
        self._set_limits()
        self._note_trouble()
        await self._find_stranded(client)
        self._tell()

    def _set_limits(self) -> None:
        for gate, special in ((self._gate, _NO_NEEDS), (self._merge_gate, self._merging)):
            gate.set_slots(self._roster.slots(special))

    def _note_trouble(self) -> None:
        found = self._roster.trouble(_NO_NEEDS) or self._roster.trouble(self._merging)
        if found != self._trouble and found is not None:
            logger.warning("%s; jobs wait until then", found)
        self._trouble = found

    async def _find_stranded(self, client: Client) -> None:
        """Take back jobs that no worker has: the one that had them is gone, and none that joined
        since was admitted when the scheduler looked for another."""
        if not self._flights:
            return
        waiting = dict(self._flights)
        with_workers = {key for keys in (await client.processing()).values() for key in keys}
        for key, flight in waiting.items():
            there = key in with_workers or flight.future.status != "pending"
            flight.missed = 0 if there else flight.missed + 1
            if flight.missed > 2:
                flight.lost.set()

    async def _nobody_there(self, special: Needs) -> None:
        """Return once nobody could be given such a job for as long as somebody should wait."""
        since = time.monotonic()
        while (gone_s := time.monotonic() - since) < self._config.connect_timeout_s:
            with contextlib.suppress(TimeoutError):
                left_s = self._config.connect_timeout_s - gone_s
                await asyncio.wait_for(self._looked.wait(), left_s)
            if self._roster.slots(special):
                since = time.monotonic()

    def _give_up_flights(self) -> None:
        for flight in self._flights.values():
            flight.lost.set()

    def _tell(self) -> None:
        looked, self._looked = self._looked, asyncio.Event()
        looked.set()

    def _no_scheduler(self, error: Exception) -> str:
        address, why = self._config.scheduler, str(error) or type(error).__name__
        port = address.rpartition(":")[2]
        return (
            f"no Dask scheduler can be used at {address} ({why}); start "
            f"one there (dask scheduler --port {port}), or correct jobs.scheduler"
        )


class _GaveUp(Exception):
    """The cluster could not run a job, for a reason that may be the job's own."""


async def _closed(client: Client) -> None:
    closing: Any = client.close(timeout=2.0)  # awaitable where the client is asynchronous
    await closing


async def _let_go(client: Client, future: Future) -> None:
    """The scheduler may forget a job; a worker that still runs it ends it."""
    if client.status == "running":
        try:
            if not future.done():
                await asyncio.shield(client.cancel([future], force=True))
            future.release()
        except Exception:
            logger.debug("the scheduler was not told to forget a job", exc_info=True)
