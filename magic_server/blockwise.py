"""Merging block by block: a job that plans, jobs for each block, a job that joins them.

Each block is refined twice, by itself and then shortly beside its refined neighbours, and has a
folder for each. After a restart of the server the jobs of blocks that were done find them done; one
that was begun goes on from its last checkpoint in the first round, and begins anew in the second.
Where jobs leave their files in a bucket, which keeps no folders, all of it begins anew.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from magicslam.v1 import submap_pb2

from magic_server.globalmap.blocks import REFINED, blocks_near
from magic_server.jobs import JobExecutor
from magic_server.jobs.blockwise import (
    BlockOutcome,
    BlockTask,
    JoinTask,
    PlannedBlock,
    PlanTask,
    TouchTask,
    join_blocks,
    plan_merge,
    refine_block,
    touch_up_block,
)
from magic_server.jobs.delivery import Deliveries, Delivery, Progress
from magic_server.jobs.tasks import MergeOutcome, MergeTask
from magic_server.store.blob_store import StreamedFile

_PLANNED = 0.05
"""Share of the progress when space is divided."""


def is_blockwise(task: MergeTask) -> bool:
    """Whether a merge takes several blocks: it has more keyframes than one may have. For a thread:
    it reads every header."""
    if not task.config.refine:
        return False
    headers = (submap_pb2.SubmapHeader.FromString(item.stored.header) for item in task.submaps)
    return sum(len(header.keyframes) for header in headers) > task.config.block_views


class BlockwiseMerge:
    """One merge in several blocks."""

    def __init__(
        self,
        task: MergeTask,
        folder: Path,
        *,
        jobs: JobExecutor,
        deliveries: Deliveries,
        at_once: int,
    ) -> None:
        """`at_once`: blocks that are refined at the same time."""
        self._task, self._folder = task, folder
        self._jobs, self._deliveries = jobs, deliveries
        self._turn = asyncio.Semaphore(at_once)
        self._planning = deliveries.of(folder / "plan")
        self._begun: dict[int, Delivery] = {}
        self._round = "dividing space into blocks"
        self._before, self._share, self._done, self._count = 0.0, 0.0, 0, 0
        self._told = 0.0

    async def run(self) -> MergeOutcome:
        """The merged map; the first error of any job ends all."""
        plan = PlanTask(self._task.submaps, self._task.config, self._planning)
        planned = await self._jobs.run(plan_merge, plan)
        tasks = [self._block_task(block, f"block-{i:04d}") for i, block in enumerate(planned)]
        self._begin_round("refining", len(planned), before=_PLANNED, share=REFINED - _PLANNED)
        files = await self._each(refine_block, [(task, task.delivery) for task in tasks])

        blocks = [task.block for task in tasks]
        tasks = [self._block_task(block, f"border-{i:04d}") for i, block in enumerate(planned)]
        touching = [
            TouchTask(task, files[i], tuple(files[other] for other in blocks_near(blocks, i)))
            for i, task in enumerate(tasks)
        ]
        self._begin_round("refining borders", len(planned), before=REFINED, share=1.0 - REFINED)
        files = await self._each(touch_up_block, [(task, task.block.delivery) for task in touching])
        self._round = "joining blocks"
        joining = JoinTask(tuple(files), self._deliveries.of(self._folder / "join"))
        return await self._jobs.run(join_blocks, joining)

    def _begin_round(self, name: str, count: int, *, before: float, share: float) -> None:
        self._round, self._count, self._done = name, count, 0
        self._before, self._share = before, share

    def _block_task(self, planned: PlannedBlock, folder: str) -> BlockTask:
        return BlockTask(
            tuple(self._task.submaps[i] for i in planned.submaps),
            planned.block,
            self._task.config,
            self._task.threads,
            self._deliveries.of(self._folder / folder),
        )

    async def _each(
        self, function: Callable[[Any], BlockOutcome], tasks: Sequence[tuple[Any, Delivery]]
    ) -> list[StreamedFile]:
        """The file of each block, in order."""
        try:
            async with asyncio.TaskGroup() as group:
                made = [
                    group.create_task(self._one(number, function, *task))
                    for number, task in enumerate(tasks)
                ]
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None
        outcomes = [one.result() for one in made]
        return [self._deliveries.streamed(one.file, one.sha256) for one in outcomes]

    async def _one(
        self, number: int, function: Callable[[Any], BlockOutcome], task: Any, delivery: Delivery
    ) -> BlockOutcome:
        async with self._turn:
            self._begun[number] = delivery
            try:
                made = await self._jobs.run(function, task)
                self._done += 1
                return made
            finally:
                del self._begun[number]

    def progress(self) -> Progress:
        """Share done, the sum over the blocks, and stage. For a thread."""
        said = {number: delivery.progress() for number, delivery in list(self._begun.items())}
        known = {number: report for number, report in said.items() if report is not None}
        stages = [f"block {n + 1} {text}" for n, (_, text) in sorted(known.items())[:3]]
        stage = self._round
        if self._count:
            done = self._done + sum(share for share, _ in known.values())
            # A block that is begun again elsewhere says less than before.
            share = self._before + self._share * min(1.0, done / self._count)
            self._told = max(self._told, share)
            stage = f"{self._round}, {self._done} of {self._count} blocks done"
        elif (planned := self._planning.progress()) is not None:
            self._told = max(self._told, _PLANNED * planned[0])
        return self._told, "; ".join([stage, *stages])
