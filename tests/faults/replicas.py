"""Kills, or stops for a while, one of two servers that share a PostgreSQL database.

    python -m tests.faults.replicas --runs 100 --seed 1 --json

In each run eight agents upload, four in each of two new sessions, to whichever server has theirs.
At a moment chosen by the seed the server that holds the first session is killed; or it is halted
(`--halts` of the runs), loses its leases without knowing, and goes on. Every agent must have a
sub-map acknowledged within 10 s of that. In the end everything that was acknowledged must be there,
byte for byte and once, and placed in its session's pose graph. Then the server that was killed is
started again.

Exits with 1 when anything was lost, doubled or damaged, or an agent waited for longer.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from magic_agent.client import ClientConfig, MagicClient
from magic_core.wire import EncodedSubmap, Transport
from tests.faults.recorded import SESSION, recording
from tests.faults.server_process import ServerForge, ServerProcess
from tests.postgresql import postgres_server
from tests.small_world import DIMENSION, MODEL_ID
from tests.waiting import eventually

AGENTS = 8
SESSIONS = 2
SUBMAPS = 4
LIMIT_S = 10.0
HALTED_S = 8.0
"""Longer than a lease."""
REPLICAS = ("a", "b")
KEEPALIVE_S = 2.0
CLIENT = ClientConfig(
    rpc_timeout_s=60.0,
    connect_timeout_s=60.0,
    transport=Transport(keepalive_s=KEEPALIVE_S, keepalive_timeout_s=KEEPALIVE_S),
)


@dataclass(slots=True)
class Figures:
    """What came out."""

    runs: int = 0
    kills: int = 0
    halts: int = 0
    acknowledged: int = 0
    lost: int = 0
    duplicated: int = 0
    damaged: int = 0
    unplaced: int = 0
    """Sub-maps that the session's pose graph did not take up."""
    late: int = 0
    """Agents that waited for more than 10 s."""
    carried_on: int = 0
    """Agents that had sub-maps left when their server, or the other one, was lost."""
    waits_s: list[float] = field(default_factory=list)
    """The longest wait of an agent of the session whose server was lost, for each run."""
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        return not any((self.lost, self.duplicated, self.damaged, self.unplaced, self.late))

    def summary(self) -> dict:
        """The figures, with the waits by their quantiles."""
        waits = sorted(self.waits_s)
        shown = asdict(self) | {"good": self.good}
        del shown["waits_s"]
        if waits:
            shown["wait_p50_s"] = round(waits[len(waits) // 2], 2)
            shown["wait_max_s"] = round(waits[-1], 2)
        return shown


class Cluster:
    """Two servers of one database and one folder."""

    def __init__(self, folder: Path, database: str, forge: ServerForge) -> None:
        self._folder = folder
        self._database = database
        self._forge = forge
        self._ports = {name: _free_port() for name in REPLICAS}
        self._servers: dict[str, ServerProcess] = {}

    @property
    def target(self) -> str:
        """Both addresses."""
        return ",".join(self.address(name) for name in REPLICAS)

    def address(self, name: str) -> str:
        return f"127.0.0.1:{self._ports[name]}"

    async def start(self, name: str) -> None:
        """Start a server and wait until it takes calls."""
        settings = {
            "data_dir": str(self._folder),
            "database": self._database,
            "replica": name,
            "port": self._ports[name],
            "keepalive_s": KEEPALIVE_S,
            "keepalive_timeout_s": KEEPALIVE_S,
        }
        self._servers[name] = await self._forge.start(settings)
        await self._servers[name].ready()

    async def kill(self, name: str) -> None:
        await self._servers[name].end()

    def halt(self, name: str) -> None:
        os.kill(self._servers[name].pid, signal.SIGSTOP)

    def go_on(self, name: str) -> None:
        os.kill(self._servers[name].pid, signal.SIGCONT)


class Run:
    """Agents that upload, and what they were told."""

    def __init__(
        self,
        number: int,
        cluster: Cluster,
        *,
        recorded: list[list[EncodedSubmap]],
        figures: Figures,
        rng: random.Random,
    ) -> None:
        self._cluster = cluster
        self._figures = figures
        self._rng = rng
        self._sessions = [f"{SESSION}-{number}-{k}" for k in range(SESSIONS)]
        self._sent = [
            [_moved(submap, self._sessions[agent % SESSIONS]) for submap in recorded[agent]]
            for agent in range(AGENTS)
        ]
        self._acknowledged: dict[str, float] = {}

    async def play(self, *, halt: bool) -> None:
        """Upload, lose a server on the way, upload the rest, and look."""
        agents = [asyncio.create_task(self._agent(agent)) for agent in range(AGENTS)]
        wanted = self._rng.randint(1, AGENTS * SUBMAPS // 2)
        await eventually(lambda: len(self._acknowledged) >= wanted, timeout_s=60.0)
        await asyncio.sleep(self._rng.uniform(0.0, 0.05))
        holder = await self._holder(self._sessions[0])
        left = [a for a in range(AGENTS) if self._left(a)]
        lost_at = time.monotonic()
        if halt:
            self._cluster.halt(holder)
        else:
            await self._cluster.kill(holder)
        again = asyncio.create_task(self._bring_back(holder, halt=halt))
        await asyncio.gather(*agents)
        self._measure(left, lost_at)
        await self._check()
        await again
        self._figures.halts += halt
        self._figures.kills += not halt

    async def _bring_back(self, name: str, *, halt: bool) -> None:
        await asyncio.sleep(HALTED_S)
        if halt:
            self._cluster.go_on(name)
        else:
            await self._cluster.start(name)

    async def _holder(self, session: str) -> str:
        """Which server works on a session."""
        async with MagicClient(self._cluster.target, CLIENT) as client:
            await client.get_corrected_poses(session)
            current = client._targets.current
        return next(name for name in REPLICAS if self._cluster.address(name) == current)

    async def _agent(self, agent: int) -> None:
        name, session = f"agent_{agent}", self._sessions[agent % SESSIONS]
        # Half of the agents know the servers in another order.
        target = ",".join(sorted(self._cluster.target.split(","), reverse=agent % SESSIONS == 1))
        async with MagicClient(target, CLIENT) as client:
            await client.register_agent(session, name, model_id=MODEL_ID, dimension=DIMENSION)
            for submap in self._sent[agent]:
                await client.submit_encoded(submap)
                self._acknowledged[submap.header.name] = time.monotonic()
                await asyncio.sleep(0.2)
            await client.finish_agent(session, name)

    def _left(self, agent: int) -> list[str]:
        """Its sub-maps that are not acknowledged."""
        names = [submap.header.name for submap in self._sent[agent]]
        return [name for name in names if name not in self._acknowledged]

    def _measure(self, left: list[int], lost_at: float) -> None:
        waits = {}
        for agent in left:
            times = [self._acknowledged.get(s.header.name, lost_at) for s in self._sent[agent]]
            waits[agent] = min(at for at in times if at > lost_at) - lost_at
        self._figures.carried_on += len(waits)
        self._figures.late += sum(wait > LIMIT_S for wait in waits.values())
        hit = [wait for agent, wait in waits.items() if agent % SESSIONS == 0]
        if hit:
            self._figures.waits_s.append(max(hit))

    async def _check(self) -> None:
        """Everything that was acknowledged is there, whole and once, and placed."""
        figures = self._figures
        figures.acknowledged += len(self._acknowledged)
        sent = {submap.header.name: submap for one in self._sent for submap in one}
        async with MagicClient(self._cluster.target, CLIENT) as client:
            for number, session in enumerate(self._sessions):
                wanted = {name for name in sent if name.startswith(f"sessions/{session}/")}
                stored = [info.name for info in await client.list_submaps(session)]
                figures.lost += len(wanted - set(stored))
                figures.duplicated += len(stored) - len(set(stored))
                for name in stored:
                    found = await client.download_encoded(name)
                    same = (found.header, found.blobs) == (sent[name].header, sent[name].blobs)
                    figures.damaged += not same
                for agent in range(number, AGENTS, SESSIONS):
                    parts = await client.get_trajectory(session, f"agent_{agent}", wait_s=30.0)
                    figures.unplaced += SUBMAPS - len(parts)


def _moved(submap: EncodedSubmap, session: str) -> EncodedSubmap:
    """A recorded sub-map as one of another session."""
    header = type(submap.header)()
    header.CopyFrom(submap.header)
    header.name = header.name.replace(f"sessions/{SESSION}/", f"sessions/{session}/", 1)
    header.request_id = header.name
    return EncodedSubmap(header, submap.blobs)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


async def campaign(
    *,
    runs: int,
    seed: int,
    halts: float,
    on_run: Callable[[Figures], None] = lambda figures: None,
    log: int = asyncio.subprocess.DEVNULL,
) -> Figures:
    """So many losses of a server; `on_run` is told after each."""
    figures = Figures()
    begin = time.monotonic()
    recorded = recording(agents=AGENTS, submaps=SUBMAPS)
    with postgres_server() as postgres, tempfile.TemporaryDirectory() as folder:
        async with ServerForge(log) as forge:
            cluster = Cluster(Path(folder), postgres.database(), forge)
            for name in REPLICAS:
                await cluster.start(name)
            for number in range(runs):
                rng = random.Random(f"{seed}/{number}")
                run = Run(number, cluster, recorded=recorded, figures=figures, rng=rng)
                await run.play(halt=rng.random() < halts)
                figures.runs += 1
                figures.seconds = round(time.monotonic() - begin, 1)
                on_run(figures)
    return figures


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--halts", type=float, default=0.25, help="share of runs without a kill")
    parser.add_argument("--log", type=Path, help="file for what the servers write")
    parser.add_argument("--json", action="store_true", help="print one JSON object and no more")
    options = parser.parse_args()

    def show(figures: Figures) -> None:
        print(json.dumps(figures.summary()), file=sys.stderr, flush=True)

    log = options.log.open("wb").fileno() if options.log else asyncio.subprocess.DEVNULL
    figures = asyncio.run(
        campaign(runs=options.runs, seed=options.seed, halts=options.halts, on_run=show, log=log)
    )
    if options.json:
        print(json.dumps(figures.summary()))
    else:
        for name, value in figures.summary().items():
            print(f"{name:20} {value}")
    return 0 if figures.good else 1


if __name__ == "__main__":
    sys.exit(main())
