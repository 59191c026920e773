"""The workers of a cluster as one server sees them: who may be given which jobs."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from magic_server.jobs.cluster.admission import ServedStore, admit, resource_of, versions

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

ASK_AGAIN_S = 15.0
"""A worker that could not be used is asked again after this long: somebody may have mended it."""
ANSWER_S = 10.0

Needs = Mapping[str, float]
"""Resources that a job demands of a worker."""


class Roster:
    """Asks every new worker whether it can do this server's jobs."""

    def __init__(self, scheduler: str, store: ServedStore) -> None:
        self._scheduler = scheduler
        self._resource = resource_of(store.id)
        self._store = store
        self._known: dict[str, dict[str, Any]] = {}
        self._refused: dict[str, tuple[float, str]] = {}

    def needs(self, special: Needs) -> dict[str, float]:
        """What a job demands of a worker: that it reaches the blobs, and what is special."""
        return {self._resource: 1.0, **special}

    def slots(self, special: Needs) -> int:
        """How many jobs that demand this could run at once."""
        able = self._able(special)
        if not special:
            return sum(int(worker["nthreads"]) for worker in able)
        return sum(
            min(int(w["nthreads"]), *(int(w["resources"][k] // v) for k, v in special.items()))
            for w in able
        )

    def trouble(self, special: Needs) -> str | None:
        """Why nobody could be given such a job, and what helps; None where somebody could."""
        if self.slots(special):
            return None
        command = f"magic worker {self._scheduler}"
        if not self._known:
            return f"the scheduler at {self._scheduler} has no workers; start one: {command}"
        if self._able({}):
            asked = ",".join(f"{name}={amount:g}" for name, amount in special.items())
            return f"no worker offers {asked}; start one: {command} --resources {asked}"
        reasons = "; ".join(sorted({reason for _, reason in self._refused.values()}))
        count = len(self._known)
        return f"none of the {count} workers at {self._scheduler} can be used: {reasons}"

    def clear(self) -> None:
        """Forget everybody: the scheduler is gone."""
        self._known, self._refused = {}, {}

    async def look(self, client: Client) -> None:
        """Learn who is there now, and admit who is new."""
        self._known = await self._present(client)
        self._refused = {
            key: refusal
            for key, refusal in self._refused.items()
            if any(_key(address, worker) == key for address, worker in self._known.items())
        }
        new = [
            (address, worker)
            for address, worker in self._known.items()
            if self._resource not in worker["resources"] and self._may_ask(_key(address, worker))
        ]
        answers = await asyncio.gather(*(self._ask(client, address) for address, _ in new))
        for (address, worker), reason in zip(new, answers, strict=True):
            self._note(_key(address, worker), worker, reason)

    async def _present(self, client: Client) -> dict[str, dict[str, Any]]:
        if client.scheduler is None:
            raise ConnectionError("the connection was lost")
        seen: Any = await client.scheduler.identity(n_workers=-1)
        return {address: dict(worker) for address, worker in seen["workers"].items()}

    def _able(self, special: Needs) -> list[dict[str, Any]]:
        needs = self.needs(special)
        return [
            worker
            for worker in self._known.values()
            if all(worker["resources"].get(name, 0.0) >= needs[name] for name in needs)
        ]

    def _may_ask(self, key: str) -> bool:
        return key not in self._refused or time.monotonic() - self._refused[key][0] > ASK_AGAIN_S

    async def _ask(self, client: Client, address: str) -> str | None:
        """None where a worker is admitted, else why it is not."""
        question = (self._store, versions())
        try:
            async with asyncio.timeout(ANSWER_S):
                answers = await client.run(admit, *question, workers=[address], on_error="return")
        except (OSError, TimeoutError) as error:
            return f"{address} does not answer ({str(error) or 'timeout'})"
        answer = answers.get(address, "it went away")
        if isinstance(answer, Exception):
            remedy = "is magic-slam[cluster] of this server's version installed there?"
            return f"{address} cannot run magic-slam's jobs ({answer}); {remedy}"
        return answer

    def _note(self, key: str, worker: dict[str, Any], reason: str | None) -> None:
        if reason is None:
            self._refused.pop(key, None)
            worker["resources"] = {**worker["resources"], self._resource: worker["nthreads"]}
            logger.info("worker %s joins: %d jobs at a time", worker["name"], worker["nthreads"])
            return
        if self._refused.get(key, (0.0, ""))[1] != reason:
            logger.warning("worker %s is given no jobs: %s", worker["name"], reason)
        self._refused[key] = (time.monotonic(), reason)


def _key(address: str, worker: Mapping[str, Any]) -> str:
    """Of one life of a worker: another process may get the address of one that ended."""
    return f"{address} {worker['id']}"
