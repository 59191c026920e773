"""What agents, sessions and callers may take: bytes, sub-maps, calls, and how fast.

Totals are read from the store each time, so that what is deleted counts no more; uploads under way
are added to them. Rates are token buckets that may go into debt: a sub-map larger than a second's
share is admitted and paid off by the wait of the next.
"""

from __future__ import annotations

import contextlib
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

from magic_core.errors import ConfigError, Overloaded, QuotaExceeded, RateLimited
from magic_core.wire import names
from magic_server.resources import Resources
from magic_server.store import AgentRow, Store

MAX_BUCKETS = 10_000
"""Callers whose rate is remembered; the one unseen for longest is forgotten first."""
BACKLOG_RETRY_S = 5.0


@dataclass(frozen=True, slots=True)
class QuotaConfig:
    """Shares; None is unlimited. Sizes of a single sub-map are in `limits.submap`."""

    agent_submaps: int | None = None
    """Sub-maps stored for one agent."""
    agent_bytes: int | None = None
    """Bytes stored for one agent."""
    agent_submaps_per_minute: float | None = None
    """Sub-maps an agent may begin to send."""
    agent_bytes_per_s: float | None = None
    """Bytes an agent may send, on average."""
    session_agents: int | None = None
    """Agents in one session."""
    session_submaps: int | None = None
    """Sub-maps stored in one session."""
    session_bytes: int | None = None
    """Bytes stored in one session."""
    session_submaps_per_minute: float | None = None
    """Sub-maps all agents of a session may begin to send."""
    session_bytes_per_s: float | None = None
    """Bytes all agents of a session may send, on average."""
    sessions: int | None = None
    """Sessions on the server."""
    calls_per_s: float | None = None
    """Calls of one caller: its token or certificate, else its address."""
    burst_s: float = 10.0
    """So many seconds' worth of a rate may come at once."""
    retry_s: float = 60.0
    """How long callers are asked to wait when a total is used up: somebody may delete."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ConfigError.field(f"quotas.{name}", f"{value}: expected above 0, or none")


@dataclass(slots=True)
class _Held:
    """What uploads under way will add."""

    submaps: int = 0
    bytes: int = 0


class Quotas:
    """Admits uploads, registrations and calls, or says what is used up and how long to wait."""

    def __init__(
        self,
        store: Store,
        config: QuotaConfig,
        *,
        resources: Resources,
        backlog: Callable[[str], int],
        max_backlog: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`backlog(session)` is the number of searches and verifications that wait there."""
        self._store = store
        self._config = config
        self._resources = resources
        self._backlog = backlog
        self._max_backlog = max_backlog
        self._rates = Rates(config.burst_s, clock)
        self._held: dict[str, _Held] = {}
        self._paid: OrderedDict[str, None] = OrderedDict()

    @property
    def held_submaps(self) -> int:
        """Sub-maps that are being received."""
        return sum(held.submaps for key, held in list(self._held.items()) if "/agents/" not in key)

    @property
    def held_bytes(self) -> int:
        """Bytes that uploads under way have announced."""
        return sum(held.bytes for key, held in list(self._held.items()) if "/agents/" not in key)

    @contextlib.asynccontextmanager
    async def upload(self, agent: AgentRow, length: int, *, key: str) -> AsyncIterator[None]:
        """Holds room for a sub-map of `length` bytes while it is being received.

        `key` names the upload: one that is taken up again after a cut pays its rate once.
        Raises QuotaExceeded, RateLimited, Overloaded, DiskFull or MemoryLow instead of entering.
        """
        session = names.session_name(agent.session.name)
        name = names.agent_name(agent.session.name, agent.name)
        self._require_short_backlog(agent.session.name)
        with self._holding((session, name), length):
            # Held first, then checked: two uploads at once cannot both take the last place.
            await self._resources.require(self.held_bytes)
            await self._require_totals(agent, session=session, name=name)
            if key not in self._paid:
                self._spend_rates(session, name, length)
                self._paid[key] = None
                if len(self._paid) > MAX_BUCKETS:
                    self._paid.popitem(last=False)
            yield
            self._paid.pop(key, None)

    async def registration(self, session: str, agent: str) -> None:
        """Check that an agent may enter. Raises QuotaExceeded."""
        config = self._config
        if config.sessions is None and config.session_agents is None:
            return
        count = await self._store.usage.population(session, agent)
        if config.sessions is not None and count.session_is_new:
            self._require("sessions", count.sessions + 1, config.sessions, "this server")
        if config.session_agents is not None and count.agent_is_new:
            what = names.session_name(session)
            self._require("agents", count.agents + 1, config.session_agents, what)

    def call(self, caller: str) -> None:
        """Count a call of a caller. Raises RateLimited."""
        if self._config.calls_per_s is not None:
            wait_s = self._rates.spend(f"calls {caller}", 1.0, self._config.calls_per_s)
            self._require_rate(wait_s, f"{caller}: more than {self._config.calls_per_s:g} calls/s")

    @contextlib.contextmanager
    def _holding(self, keys: tuple[str, ...], length: int):
        for key in keys:
            held = self._held.setdefault(key, _Held())
            held.submaps, held.bytes = held.submaps + 1, held.bytes + length
        try:
            yield
        finally:
            for key in keys:
                held = self._held[key]
                held.submaps, held.bytes = held.submaps - 1, held.bytes - length
                if not held.submaps:
                    del self._held[key]

    def _require_short_backlog(self, session: str) -> None:
        waiting = self._backlog(session)
        if waiting >= self._max_backlog:
            raise Overloaded(
                f"{names.session_name(session)}: {waiting} sub-maps and loops wait to be looked "
                f"at, this server keeps {self._max_backlog}; try again",
                retry_after_s=BACKLOG_RETRY_S,
            )

    async def _require_totals(self, agent: AgentRow, *, session: str, name: str) -> None:
        config, usage = self._config, self._store.usage
        totals = (
            (name, usage.of_agent, config.agent_submaps, config.agent_bytes),
            (session, usage.of_session, config.session_submaps, config.session_bytes),
        )
        for what, stored_by, max_submaps, max_bytes in totals:
            if max_submaps is None and max_bytes is None:
                continue
            stored, held = await stored_by(agent), self._held[what]
            self._require("sub-maps", stored.submaps + held.submaps, max_submaps, what)
            self._require("bytes", stored.bytes + held.bytes, max_bytes, what)

    def _require(self, unit: str, wanted: int, limit: int | None, what: str) -> None:
        if limit is not None and wanted > limit:
            raise QuotaExceeded(
                f"{what} would have {wanted} {unit}, its quota is {limit}; delete some or ask for "
                "more",
                retry_after_s=self._config.retry_s,
            )

    def _spend_rates(self, session: str, name: str, length: int) -> None:
        config = self._config
        for what, per_minute, bytes_per_s in (
            (name, config.agent_submaps_per_minute, config.agent_bytes_per_s),
            (session, config.session_submaps_per_minute, config.session_bytes_per_s),
        ):
            if per_minute is not None:
                wait_s = self._rates.spend(f"submaps {what}", 1.0, per_minute / 60.0)
                self._require_rate(wait_s, f"{what}: more than {per_minute:g} sub-maps/min")
            if bytes_per_s is not None:
                wait_s = self._rates.spend(f"bytes {what}", float(length), bytes_per_s)
                self._require_rate(wait_s, f"{what}: more than {bytes_per_s:g} bytes/s")

    @staticmethod
    def _require_rate(wait_s: float, what: str) -> None:
        if wait_s > 0:
            raise RateLimited(f"{what}; wait {wait_s:.2f} s", retry_after_s=wait_s)


class Rates:
    """Token buckets by name, a bounded number of them."""

    def __init__(self, burst_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._burst_s = burst_s
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens, seen at

    def spend(self, name: str, amount: float, per_s: float) -> float:
        """Take from a bucket: 0, or the seconds to wait when it is empty and nothing was taken."""
        now = self._clock()
        capacity = max(1.0, per_s * self._burst_s)
        tokens, seen = self._buckets.pop(name, (capacity, now))
        tokens = min(capacity, tokens + (now - seen) * per_s)
        admitted = tokens >= min(amount, capacity)
        self._buckets[name] = (tokens - amount if admitted else tokens, now)
        if len(self._buckets) > MAX_BUCKETS:
            self._buckets.popitem(last=False)
        return 0.0 if admitted else (min(amount, capacity) - tokens) / per_s
