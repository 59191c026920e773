"""Uploads through networks that fail: they finish, nothing is there twice, little is sent twice.

    python -m tests.faults.network --runs 20 --seed 1 --json

A run is one server behind a proxy with one kind of weather, and four agents that send two sub-maps
of about 3 MB each at once. Every kind of weather takes its turn: clear (the measure of time and
bytes), delays that let connections overtake each other, throttling, a slow link, cuts within
chunks, refused connections, links that fall silent, and all of it. Afterwards every sub-map must be
there once and byte for byte. Exits with 1 when one is not, when a run took longer than its bound,
or when bytes were sent again over a link that was not cut.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict, dataclass, field

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import DeadlineExceeded, Unavailable
from magic_core.wire import EncodedSubmap, Transport, names
from tests.faults.proxy import Proxy, Weather
from tests.faults.recorded import large_recording
from tests.faults.server_process import ServerForge
from tests.small_world import DIMENSION, MODEL_ID

AGENTS, SUBMAPS = 4, 2
KEEPALIVE_S = 2.0
KEEPALIVE_TIMEOUT_S = 2.0
RETRY_S = 1.0
"""Longest pause between attempts."""

NEEDLESS = 0.01
"""Share of bytes that pings and repeated calls may add to a link that was never cut."""

CUT = (200_000, 5_000_000)
WEATHERS = {
    "clear": Weather(),
    "delayed": Weather(delay_s=0.03),
    "throttled": Weather(bytes_per_s=6_000_000.0),
    "slow": Weather(bytes_per_s=300_000.0),
    "cut": Weather(cut_after=CUT, cuts=12),
    "refused": Weather(cut_after=CUT, cuts=6, refuse=0.3),
    "silent": Weather(cut_after=CUT, cuts=4, silent=1.0),
    "all": Weather(
        delay_s=0.01, bytes_per_s=10_000_000.0, cut_after=CUT, cuts=8, refuse=0.2, silent=0.25
    ),
}


@dataclass(slots=True)
class Kind:
    """What one kind of weather did, over its runs."""

    runs: int = 0
    cuts: int = 0
    silences: int = 0
    refused: int = 0
    seconds: float = 0.0
    """Mean time from the first byte to the last acknowledgement."""
    lost_seconds: float = 0.0
    """Most that a run took longer than the clear one, beyond what throttle and delay cost."""
    bytes_sent: int = 0
    """Mean bytes that the proxy carried towards the server."""
    resent_share: float = 0.0
    """Bytes beyond those of the clear runs, relative to them."""


@dataclass(slots=True)
class Figures:
    """What came out."""

    runs: int = 0
    acknowledged: int = 0
    lost: int = 0
    duplicated: int = 0
    damaged: int = 0
    over_bound: int = 0
    """Runs that took longer than their bound."""
    resent_needlessly: int = 0
    """Runs without a cut in which bytes were sent again."""
    stopped_s: float = 0.0
    """Time in which the machine did not run the campaign at all, counted as no link's fault."""
    kinds: dict[str, Kind] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        stored_wrongly = self.lost or self.duplicated or self.damaged
        return not (stored_wrongly or self.over_bound or self.resent_needlessly)


@dataclass(frozen=True, slots=True)
class Run:
    """One run's measurements."""

    seconds: float
    """Without the time in which the machine did not run it."""
    stopped_s: float
    bytes_up: int
    cuts: int
    silences: int
    refused: int


def lost_time_bound_s(run: Run) -> float:
    """What the faults of a run may cost: each cut a pause, each silence the keepalive first.

    Four agents share a connection each; a fault holds up one of them.
    """
    pauses = run.cuts + run.refused
    return 2.0 + pauses * (RETRY_S + 0.5) + run.silences * (KEEPALIVE_S + KEEPALIVE_TIMEOUT_S + 1.0)


class Standstill:
    """Measures how long this process is not run: stopped, or kept from every processor.

    A heartbeat comes late then, and next to no processor time has passed; an event loop that its
    own code holds up uses some.
    """

    BEAT_S, LEAST_S, IDLE_SHARE = 0.1, 1.0, 0.05

    def __init__(self) -> None:
        self.seconds = 0.0

    async def __aenter__(self) -> Standstill:
        self._task = asyncio.create_task(self._beat())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()

    async def _beat(self) -> None:
        while True:
            began, used = time.monotonic(), time.process_time()
            await asyncio.sleep(self.BEAT_S)
            late_s = time.monotonic() - began - self.BEAT_S
            worked_s = time.process_time() - used
            if late_s > self.LEAST_S and worked_s < self.IDLE_SHARE * late_s:
                self.seconds += late_s


async def one_run(
    forge: ServerForge,
    recorded: list[list[EncodedSubmap]],
    weather: Weather,
    *,
    rng: random.Random,
    figures: Figures,
) -> Run:
    """A fresh server behind a proxy; every agent to its end."""
    with tempfile.TemporaryDirectory() as folder:
        settings = {
            "data_dir": folder,
            "keepalive_s": KEEPALIVE_S,
            "keepalive_timeout_s": KEEPALIVE_TIMEOUT_S,
        }
        server = await forge.start(settings)
        address = await server.ready()
        async with Proxy(address, weather, rng) as proxy:
            begin = time.monotonic()
            async with Standstill() as standstill, asyncio.TaskGroup() as group:
                for submaps in recorded:
                    group.create_task(_upload(proxy.address, submaps, figures))
            seconds = time.monotonic() - begin - standstill.seconds
            traffic = proxy.traffic
        await _check(address, recorded, figures)
        await server.end()
    stopped_s = standstill.seconds
    return Run(
        seconds, stopped_s, traffic.bytes_up, traffic.cuts, traffic.silences, traffic.refused
    )


async def _upload(address: str, submaps: list[EncodedSubmap], figures: Figures) -> None:
    """One agent: it sends its sub-maps and waits out whatever the network does."""
    config = ClientConfig(
        connect_timeout_s=120.0,
        rpc_timeout_s=10.0,
        attempts=40,
        max_backoff_s=RETRY_S,
        transport=Transport(keepalive_s=KEEPALIVE_S, keepalive_timeout_s=KEEPALIVE_TIMEOUT_S),
    )
    session, name, _ = names.parse_submap(submaps[0].header.name)
    async with MagicClient(address, config) as client:
        await _patiently(
            lambda: client.register_agent(session, name, model_id=MODEL_ID, dimension=DIMENSION)
        )
        for submap in submaps:
            await _submitted(client, submap)
            figures.acknowledged += 1
        await _patiently(lambda: client.finish_agent(session, name))


async def _submitted(client: MagicClient, submap: EncodedSubmap) -> None:
    resume = False

    async def attempt() -> None:
        nonlocal resume
        again, resume = resume, True
        await client.submit_encoded(submap, resume=again)

    await _patiently(attempt)


async def _patiently(attempt: Callable[[], Awaitable[object]]) -> None:
    """Try until it works, as an agent does."""
    while True:
        try:
            await attempt()
            return
        except (Unavailable, DeadlineExceeded):
            continue


async def _check(address: str, recorded: list[list[EncodedSubmap]], figures: Figures) -> None:
    """Everything is there, whole and once."""
    sent = {submap.header.name: submap for one in recorded for submap in one}
    session = names.parse_submap(next(iter(sent)))[0]
    async with MagicClient(address) as client:
        stored = [info.name for info in await client.list_submaps(session)]
        for name in set(stored):
            found = await client.download_encoded(name)
            wanted = sent[name]
            figures.damaged += (found.header, found.blobs) != (wanted.header, wanted.blobs)
    figures.lost += len(sent.keys() - set(stored))
    figures.duplicated += len(stored) - len(set(stored))


async def campaign(
    recorded: list[list[EncodedSubmap]],
    *,
    runs: int,
    seed: int,
    weathers: Mapping[str, Weather] = WEATHERS,
) -> Figures:
    """So many runs, the kinds of weather in turn; the first kind is `clear`."""
    figures, begin = Figures(), time.monotonic()
    seen: dict[str, list[Run]] = {name: [] for name in weathers}
    async with ServerForge() as forge:
        for number in range(runs):
            name = list(weathers)[number % len(weathers)]
            run = await one_run(
                forge,
                recorded,
                weathers[name],
                rng=random.Random(f"{seed}/{number}"),
                figures=figures,
            )
            seen[name].append(run)
            figures.stopped_s = round(figures.stopped_s + run.stopped_s, 1)
            figures.runs += 1
            figures.over_bound += _lost_s(run, weathers[name], seen) > lost_time_bound_s(run)
            figures.resent_needlessly += not run.cuts and _resent(run, seen) > NEEDLESS
            figures.kinds = {
                kind: _kind(seen[kind], weathers[kind], seen) for kind in weathers if seen[kind]
            }
            figures.seconds = round(time.monotonic() - begin, 1)
            print(f"\r{figures.runs} runs", end="", file=sys.stderr, flush=True)
    return figures


def _lost_s(run: Run, weather: Weather, seen: dict[str, list[Run]]) -> float:
    """Time that a run took beyond the slowest clear one and what its throttle explains."""
    clear = max(one.seconds for one in seen["clear"])
    pieces = run.bytes_up / AGENTS / (16 << 10)
    throttled = run.bytes_up / AGENTS / weather.bytes_per_s if weather.bytes_per_s else 0.0
    delayed = pieces * weather.delay_s / 2
    return max(0.0, run.seconds - clear - 1.5 * (throttled + delayed))


def _resent(run: Run, seen: dict[str, list[Run]]) -> float:
    """Bytes beyond those of the least of the clear runs, relative to them."""
    return run.bytes_up / min(one.bytes_up for one in seen["clear"]) - 1.0


def _kind(runs: list[Run], weather: Weather, seen: dict[str, list[Run]]) -> Kind:
    clear = sum(run.bytes_up for run in seen["clear"]) / len(seen["clear"])
    sent = sum(run.bytes_up for run in runs) / len(runs)
    return Kind(
        runs=len(runs),
        cuts=sum(run.cuts for run in runs),
        silences=sum(run.silences for run in runs),
        refused=sum(run.refused for run in runs),
        seconds=round(sum(run.seconds for run in runs) / len(runs), 2),
        lost_seconds=round(max(_lost_s(run, weather, seen) for run in runs), 2),
        bytes_sent=round(sent),
        resent_share=round(sent / clear - 1.0, 4),
    )


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=21)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object and no more")
    options = parser.parse_args()
    recorded = large_recording(agents=AGENTS, submaps=SUBMAPS)
    figures = asyncio.run(campaign(recorded, runs=options.runs, seed=options.seed))
    values = asdict(figures)
    if options.json:
        print(json.dumps(values))
        return 0 if figures.good else 1
    kinds = values.pop("kinds")
    for name, value in values.items():
        print(f"{name.replace('_', ' '):14} {value}")
    for name, kind in kinds.items():
        print(f"{name:10}", "  ".join(f"{key} {value}" for key, value in kind.items()))
    return 0 if figures.good else 1


if __name__ == "__main__":
    sys.exit(main())
