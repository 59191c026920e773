"""Kills servers at random moments while four agents upload, and looks for what is missing.

    python -m tests.faults.kill --runs 200 --seed 1 --json

A run is one SIGKILL of a server process with uploads under way, at a moment chosen by the seed;
some restarted servers are killed again while they start. After each run the next server must hold
every sub-map that was ever acknowledged, byte for byte and once, and no file that nothing needs.
After `--kills-per-store` runs the agents finish, and the trajectories are compared with those of a
server that was never disturbed and took the same sub-maps in the same order.

Exits with 1 when anything was lost, doubled, damaged or left over, or a trajectory differs.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import MagicError
from magic_core.wire import EncodedSubmap, names
from magic_core.wire.records import PoseSnapshot
from tests.faults.recorded import SESSION, recording
from tests.faults.server_process import ServerForge, ServerProcess
from tests.small_world import DIMENSION, MODEL_ID
from tests.waiting import eventually

AGENTS = 4
SUBMAPS = 11
MOST_ACKS = 3
KILL_AGAIN = 0.15
TOLERANCE_M = 1e-4
"""The solver starts from the last solution, so that its last digits depend on the way."""
MIN_SIMILARITY = 0.99
"""Of loop candidates: few, so that kills take the time and not registration."""
CLIENT = ClientConfig(attempts=1, rpc_timeout_s=60.0, connect_timeout_s=60.0)


@dataclass(slots=True)
class Figures:
    """What came out."""

    runs: int = 0
    acknowledged: int = 0
    lost: int = 0
    duplicated: int = 0
    damaged: int = 0
    """Stored sub-maps with other bytes than were sent."""
    orphans: int = 0
    """Files that nothing refers to, on a server that has started."""
    killed_while_starting: int = 0
    cut_uploads: int = 0
    """Uploads under way when their server was killed."""
    resumed_uploads: int = 0
    """Uploads that went on behind bytes from before a kill."""
    resumed_bytes: int = 0
    answered_twice: int = 0
    """Uploads stored before the kill, whose acknowledgement came from the next server."""
    loops: int = 0
    loops_open_at_kill: int = 0
    """Sum over the runs of the loops that were waiting or being verified."""
    stores: int = 0
    loops_that_differ: int = 0
    trajectory_difference_m: float = 0.0
    """Largest distance between a camera pose and that of the undisturbed run."""
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        bad = (self.lost, self.duplicated, self.damaged, self.orphans, self.loops_that_differ)
        return not any(bad) and self.trajectory_difference_m <= TOLERANCE_M


class Store:
    """One store through all its servers."""

    def __init__(
        self,
        folder: Path,
        forge: ServerForge,
        *,
        recorded: list[list[EncodedSubmap]],
        figures: Figures,
        rng: random.Random,
        on_run: Callable[[Figures], None],
        loops: bool = True,
    ) -> None:
        self._folder = folder
        self._forge = forge
        self._recorded = recorded
        self._sent_as = {submap.header.name: submap for one in recorded for submap in one}
        self._figures = figures
        self._rng = rng
        self._on_run = on_run
        self._similarity = MIN_SIMILARITY if loops else 1.0
        self._acknowledged: set[str] = set()
        self._attempted: set[str] = set()

    async def run(self, kills: int) -> None:
        """Upload through so many kills, then to the end, and compare."""
        server = await self._start()
        address = await server.ready()
        for _ in range(kills):
            await self._upload_and_kill(server, address)
            if self._rng.random() < KILL_AGAIN:
                server = await self._start()
                await asyncio.sleep(self._rng.uniform(0.0, 0.3))
                await server.end()
                self._figures.killed_while_starting += 1
            server = await self._start()
            address = await server.ready()
            await self._check(address)
            self._figures.runs += 1
            self._on_run(self._figures)
        await self._upload(address)
        await self._check(address)
        async with MagicClient(address, CLIENT) as client:
            result = await settled(client, len(self._sent_as))
            order = [info.name for info in await client.list_submaps(SESSION)]
        await server.end()
        await self._compare(result, order)

    async def _start(self) -> ServerProcess:
        return await self._forge.start(self._settings(self._folder))

    def _settings(self, folder: Path) -> dict:
        return {"data_dir": str(folder), "min_similarity": self._similarity, "top_k": 1}

    async def _upload(self, address: str) -> None:
        """Every agent to its end."""
        async with asyncio.TaskGroup() as group:
            for agent in range(AGENTS):
                group.create_task(self._agent(agent, address))

    async def _upload_and_kill(self, server: ServerProcess, address: str) -> None:
        """Kill the server somewhere behind a random number of acknowledgements."""
        agents = [asyncio.create_task(self._agent(i, address)) for i in range(AGENTS)]
        wanted = len(self._acknowledged) + self._rng.randint(0, MOST_ACKS)
        await eventually(
            lambda: len(self._acknowledged) >= wanted or all(task.done() for task in agents),
            timeout_s=300.0,
        )
        await asyncio.sleep(self._rng.uniform(0.0, 0.05))
        await server.end()
        ended = await asyncio.gather(*agents, return_exceptions=True)
        for error in ended:
            if error is not None and not isinstance(error, MagicError):
                raise error
        self._figures.cut_uploads += sum(error is not None for error in ended)

    async def _agent(self, agent: int, address: str) -> None:
        """Send what is not acknowledged yet, in order."""
        name = f"agent_{agent}"
        async with MagicClient(address, CLIENT) as client:
            await client.register_agent(SESSION, name, model_id=MODEL_ID, dimension=DIMENSION)
            for submap in self._recorded[agent]:
                if submap.header.name not in self._acknowledged:
                    await self._submit(client, submap)

    async def _submit(self, client: MagicClient, submap: EncodedSubmap) -> None:
        name, figures = submap.header.name, self._figures
        again = name in self._attempted
        if again:
            position = await client.resume_upload(name, submap.header.request_id)
            figures.resumed_uploads += bool(position.durable_bytes and not position.stored)
            figures.resumed_bytes += 0 if position.stored else position.durable_bytes
        self._attempted.add(name)
        receipt = await client.submit_encoded(submap, resume=again)
        figures.answered_twice += receipt.duplicate
        self._acknowledged.add(name)
        figures.acknowledged += 1

    async def _check(self, address: str) -> None:
        """Everything that was acknowledged is there, whole and once, and nothing else."""
        async with MagicClient(address, CLIENT) as client:
            if not await client.list_sessions():
                self._figures.lost += len(self._acknowledged)
                return
            stored = [info.name for info in await client.list_submaps(SESSION)]
            session = await client.get_session(SESSION)
            self._figures.loops_open_at_kill += session.pending_loops
            for name in set(stored):
                found = await client.download_encoded(name)
                sent = self._sent_as[name]
                self._figures.damaged += (found.header, found.blobs) != (sent.header, sent.blobs)
        self._figures.lost += len(self._acknowledged - set(stored))
        self._figures.duplicated += len(stored) - len(set(stored))
        wanted = {b.sha256.hex() for name in stored for b in self._sent_as[name].header.blobs}
        found = {file.name for file in (self._folder / "blobs").rglob("*") if file.is_file()}
        self._figures.orphans += len(found - wanted)
        self._figures.lost += len(wanted - found)

    async def _compare(self, result: Result, order: list[str]) -> None:
        """Hold the result against that of a server that took the sub-maps undisturbed."""
        with tempfile.TemporaryDirectory() as folder:
            server = await self._forge.start(self._settings(Path(folder)))
            async with MagicClient(await server.ready(), CLIENT) as client:
                for agent in range(AGENTS):
                    name = f"agent_{agent}"
                    await client.register_agent(
                        SESSION, name, model_id=MODEL_ID, dimension=DIMENSION
                    )
                for name in order:
                    await client.submit_encoded(self._sent_as[name])
                wanted = await settled(client, len(order))
            await server.end()
        figures = self._figures
        figures.stores += 1
        figures.loops += len(wanted.loops)
        figures.loops_that_differ += len(result.loops ^ wanted.loops)
        difference = result.difference(wanted)
        figures.trajectory_difference_m = max(figures.trajectory_difference_m, difference)


@dataclass(frozen=True, slots=True)
class Result:
    """What a server made of a session in the end."""

    loops: frozenset[tuple[str, str, str, bool]]
    """Source, target, reason, and whether the solution relies on it."""
    cameras: dict[tuple[str, int], tuple[str, np.ndarray]]
    """(agent, frame) -> (component, world_from_camera (4, 4))."""

    def difference(self, other: Result) -> float:
        """Largest distance between two poses of a frame, metres; infinite for other frames."""
        if self.cameras.keys() != other.cameras.keys():
            return float("inf")
        found = 0.0
        for frame, (component, pose) in self.cameras.items():
            other_component, other_pose = other.cameras[frame]
            if component != other_component:
                return float("inf")
            found = max(found, float(np.linalg.norm(pose[:3, 3] - other_pose[:3, 3])))
        return found


async def settled(client: MagicClient, submaps: int) -> Result:
    """The session's result once nothing is left to do."""
    last: PoseSnapshot | None = None
    steady_since = time.monotonic()
    async with asyncio.timeout(1200):
        while True:
            snapshot = await client.get_corrected_poses(SESSION)
            pending = (await client.get_session(SESSION)).pending_loops
            if last is None or snapshot.revision != last.revision or pending:
                last, steady_since = snapshot, time.monotonic()
            if len(snapshot.poses) == submaps and time.monotonic() - steady_since > 6.0:
                break
            await asyncio.sleep(0.25)
    loops = await client.list_loops(SESSION)
    cameras = {}
    for agent in range(AGENTS):
        for part in await client.get_trajectory(SESSION, f"agent_{agent}"):
            for frame in part.frames:
                key = (names.parse_submap(part.submap)[1], frame.frame_index)
                cameras[key] = (part.component, frame.world_from_camera)
    found = frozenset((c.source, c.target, c.reason, c.kept) for c in loops.candidates)
    return Result(found, cameras)


async def campaign(
    *,
    runs: int,
    seed: int,
    kills_per_store: int = 25,
    submaps: int = SUBMAPS,
    loops: bool = True,
    on_run: Callable[[Figures], None] = lambda figures: None,
) -> Figures:
    """So many kills, over as many stores as that takes; `on_run` is told after each."""
    figures = Figures()
    begin = time.monotonic()
    recorded = recording(agents=AGENTS, submaps=submaps)
    async with ServerForge() as forge:
        while figures.runs < runs:
            rng = random.Random(f"{seed}/{figures.stores}")
            kills = min(kills_per_store, runs - figures.runs)
            with tempfile.TemporaryDirectory() as folder:
                store = Store(
                    Path(folder),
                    forge,
                    recorded=recorded,
                    figures=figures,
                    rng=rng,
                    on_run=on_run,
                    loops=loops,
                )
                await store.run(kills)
            figures.seconds = round(time.monotonic() - begin, 1)
            on_run(figures)
    return figures


def _show(figures: Figures) -> None:
    """One line per run, so that a campaign that is broken off has shown how far it came."""
    print(json.dumps(asdict(figures)), file=sys.stderr, flush=True)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills-per-store", type=int, default=25)
    parser.add_argument("--json", action="store_true", help="print one JSON object and no more")
    options = parser.parse_args()
    figures = asyncio.run(
        campaign(
            runs=options.runs,
            seed=options.seed,
            kills_per_store=options.kills_per_store,
            on_run=_show,
        )
    )
    if options.json:
        print(json.dumps(asdict(figures)))
    else:
        for name, value in asdict(figures).items():
            print(f"{name.replace('_', ' '):28} {value}")
    return 0 if figures.good else 1


if __name__ == "__main__":
    sys.exit(main())
