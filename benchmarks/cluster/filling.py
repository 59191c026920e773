"""Recorded sub-map headers, put into a server's store under new names again and again."""

from __future__ import annotations

import random
import shutil
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import sqlalchemy as sa
from magicslam.v1 import geometry_pb2, submap_pb2
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from numpy.typing import NDArray

from magic_core.evaluation import RunFolder
from magic_core.wire import geometry, names
from magic_server.store import AgentRow, Asked, NewSubmap, SessionRow, Store, Vertex, schema
from magic_server.store.submaps import Arrival, submap_columns

AGENTS = 100
SESSION = "fleet"
TOGETHER = 2000
"""Sub-maps of one transaction while the database is filled."""
EACH = 10
"""Sub-maps of one place: they come one after the other, from as many agents."""
APART = 0.5
"""Length of what two descriptors of a place differ by, which have the length 1."""
LEAST_FREE = 12 << 30
"""Bytes that stay free on the disk."""


async def recorded_headers(run: RunFolder) -> list[submap_pb2.SubmapHeader]:
    """The headers of a run's sub-maps."""
    found = []
    with ThreadPoolExecutor(2) as threads:
        async with Store(run.server_folder, threads) as store:
            for name in run.read_components().anchors:
                session, agent, index = names.parse_submap(name)
                row = await store.agents.session(session)
                stored = await store.submaps.stored(row, agent, index)
                found.append(submap_pb2.SubmapHeader.FromString(stored.header))
    return found


def unit(vector: NDArray) -> NDArray[np.float32]:
    """The same of length 1."""
    return (vector / np.linalg.norm(vector)).astype(np.float32)


class Filling:
    """A store that recorded headers are put into, again and again."""

    def __init__(self, headers: list[submap_pb2.SubmapHeader]) -> None:
        self._headers = headers
        self._vectors = [unit(np.array(header.image_descriptor.vector)) for header in headers]
        self._agents: list[AgentRow] = []
        self._generator = np.random.default_rng(0)
        self._bytes = random.Random(0).randbytes  # those of numpy take ten times as long
        self._place = np.empty(0, np.float32)
        self.count = 0

    @property
    def session(self) -> SessionRow:
        """The only one."""
        return self._agents[0].session

    @property
    def dimension(self) -> int:
        """Numbers of a descriptor."""
        return len(self._vectors[0])

    async def register(self, store: Store) -> None:
        """Enter the agents."""
        descriptor = self._headers[0].image_descriptor
        for number in range(AGENTS):
            asked = Asked(uuid.uuid4().hex, bytes(32), time.time())
            entered = await store.agents.register(
                SESSION, f"a{number:02d}", model_id=descriptor.model_id,
                dimension=len(descriptor.vector), asked=asked,
            )  # fmt: skip
            self._agents.append(entered.agent)

    def arrival(self) -> Arrival:
        """The next sub-map; the agents take turns."""
        agent, index = self._agents[self.count % AGENTS], self.count // AGENTS
        found = Arrival(agent, self._new(agent, index), time.time())
        self.count += 1
        return found

    async def fill(self, store: Store, size: int, folder: Path) -> float:
        """Have so many; returns the processor's seconds for each thousand."""
        started, before = time.process_time(), self.count
        (index,) = schema.submap_blobs.indexes
        async with store._database.write() as connection:
            await connection.run_sync(index.drop)
        while self.count < size:
            if shutil.disk_usage(folder).free < LEAST_FREE:
                break
            await self._insert_many(store, min(TOGETHER, size - self.count))
        async with store._database.write() as connection:
            await connection.run_sync(index.create)
        await self._save_poses(store)
        return 1e3 * (time.process_time() - started) / max(self.count - before, 1)

    async def _insert_many(self, store: Store, count: int) -> None:
        """As `SubmapTable.insert` and a search would have left them, in fewer statements."""
        first = self.count + 1
        arrivals = [self.arrival() for _ in range(count)]
        rows = [
            submap_columns(self.session.id, one.agent.id, one.submap)
            | {"id": number, "received_at": one.at, "searched": True}
            for number, one in enumerate(arrivals, first)
        ]
        blobs = [
            {"submap_id": number, "position": position, "sha256": digest}
            for number, one in enumerate(arrivals, first)
            for position, digest in enumerate(one.submap.digests)
        ]
        async with store._database.write(self.session.id) as connection:
            await connection.execute(sa.insert(schema.submaps), rows)
            await connection.execute(sa.insert(schema.submap_blobs), blobs)
            if store._database.engine.shared:  # ids that were given do not count up
                after = sa.func.pg_get_serial_sequence("submaps", "id")
                await connection.execute(sa.select(sa.func.setval(after, first + count - 1)))

    async def _save_poses(self, store: Store) -> None:
        """Where all of them lie, as a solve of the whole graph leaves it."""
        pose = geometry_pb2.Pose(qw=1.0)
        chains = [names.submap_name(SESSION, agent.name, 0) for agent in self._agents]
        snapshot = mapping_pb.PoseSnapshot(
            session=names.session_name(SESSION),
            revision=self.count,
            poses=[
                mapping_pb.CorrectedPose(
                    submap=self.name(number), component=chains[number % AGENTS],
                    world_from_anchor=pose,
                )
                for number in range(self.count)
            ],
        )  # fmt: skip
        await store.loops.save_solution(
            self.session, revision=self.count, snapshot=snapshot.SerializeToString(), kept=set(),
            settled=True,
        )  # fmt: skip

    def some(self) -> tuple[str, int]:
        """Agent and index of any stored one."""
        number = int(self._generator.integers(self.count))
        return self._agents[number % AGENTS].name, number // AGENTS

    def name(self, number: int) -> str:
        """Resource name, by the order of arrival."""
        return names.submap_name(SESSION, self._agents[number % AGENTS].name, number // AGENTS)

    def _descriptor(self) -> NDArray[np.float32]:
        """A recorded one, moved so that ten are of one place and no two are the same."""
        size = self.dimension
        if self.count % EACH == 0 or not len(self._place):
            recorded = self._vectors[self.count // EACH % len(self._vectors)]
            self._place = unit(recorded + unit(self._generator.standard_normal(size, np.float32)))
        own = unit(self._generator.standard_normal(size, np.float32))
        return unit(self._place + np.float32(APART) * own)

    def _new(self, agent: AgentRow, index: int) -> NewSubmap:
        header = submap_pb2.SubmapHeader()
        header.CopyFrom(self._headers[self.count % len(self._headers)])
        header.name = names.submap_name(agent.session.name, agent.name, index)
        header.request_id = uuid.uuid4().hex
        header.image_descriptor.vector[:] = self._descriptor().tolist()
        header.ClearField("odometry")
        if index:
            header.odometry.previous_index = index - 1
            header.odometry.previous_from_anchor.CopyFrom(geometry.pose_to_proto(np.eye(4)))
            header.odometry.information.extend(geometry.information_to_list(np.eye(6)))
        for blob in header.blobs:  # no two sub-maps have the same ones
            blob.sha256 = self._bytes(32)
        digests = tuple(blob.sha256.hex() for blob in header.blobs)
        return NewSubmap(header, self._bytes(32), 50_000, digests, Vertex.of(header))
