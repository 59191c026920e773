"""Merging block by block: a job that plans, jobs for each block, a job that joins them.

Each block is refined in rounds, by itself and then beside its neighbours, and has a folder for
each. After a restart of the server the jobs of blocks that were done find them done; one that was
begun goes on from its last checkpoint.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from magicslam.v1 import submap_pb2

from magic_server.globalmap.blocks import ROUNDS, Neighbours
from magic_server.jobs import JobExecutor
from magic_server.jobs.blockwise import (
    BesideTask,
    BlockOutcome,
    BlockTask,
    JoinTask,
    MadeFile,
    PlannedBlock,
    PlanTask,
    RefinedBlocks,
    join_blocks,
    plan_merge,
    refine_block,
    refine_block_beside,
)
from magic_server.jobs.delivery import Deliveries, Delivery, Progress
from magic_server.jobs.tasks import MergeOutcome, MergeTask
from magic_server.store.blob_store import StreamedFile

_PLANNED = 0.05
"""Share of the progress when space is divided."""
_REFINED = 0.97
"""And when all blocks are refined."""


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
        self._planning = deliveries.of(folder / "plan", lasting=True)
        self._begun: dict[int, Delivery] = {}
        self._round = "dividing space into blocks"
        self._before, self._share, self._done, self._count = 0.0, 0.0, 0, 0
        self._told = 0.0

    async def run(self) -> MergeOutcome:
        """The merged map; the first error of any job ends all."""
        plan = PlanTask(self._task.submaps, self._task.config, self._planning)
        planned = await self._jobs.run(plan_merge, plan)
        neighbours = Neighbours([one.block for one in planned])
        first, *others = ROUNDS
        self._begin_round("refining", len(planned), first)
        tasks = [
            self._block_task(block, f"block-{i:04d}", first) for i, block in enumerate(planned)
        ]
        made = await self._each(refine_block, [(task, task.delivery) for task in tasks])
        for count, span in enumerate(others, start=1):
            self._begin_round("refining borders", len(planned), span)
            beside = [
                BesideTask(
                    self._block_task(block, f"beside-{count}-{i:04d}", span), i, span[0],
                    self._refined(made, neighbours, [i, *neighbours.near(i)]),
                )
                for i, block in enumerate(planned)
            ]  # fmt: skip
            given = [(task, task.block.delivery) for task in beside]
            made = await self._each(refine_block_beside, given)
        self._round = "joining blocks"
        joining = JoinTask(
            tuple(self._refined(made, neighbours, [i]) for i in range(len(planned))),
            self._task.config,
            self._deliveries.of(self._folder / "join", lasting=True),
        )
        return await self._jobs.run(join_blocks, joining)

    def _begin_round(self, name: str, count: int, span: tuple[float, float]) -> None:
        self._round, self._count, self._done = name, count, 0
        self._before = _PLANNED + (_REFINED - _PLANNED) * span[0]
        self._share = (_REFINED - _PLANNED) * (span[1] - span[0])

    def _block_task(
        self, planned: PlannedBlock, folder: str, span: tuple[float, float]
    ) -> BlockTask:
        return BlockTask(
            tuple(self._task.submaps[i] for i in planned.submaps),
            planned.block,
            self._task.config,
            self._task.threads,
            self._deliveries.of(self._folder / folder, lasting=True),
            span[1],
        )

    def _refined(
        self, made: Sequence[BlockOutcome], neighbours: Neighbours, numbers: Sequence[int]
    ) -> RefinedBlocks:
        """Some blocks after a round, with what others made of them."""
        own = {number: self._streamed(made[number].own) for number in numbers}
        handed = [made[other].handed for other in neighbours.showing(numbers)]
        return RefinedBlocks(own, [self._streamed(one) for one in handed if one is not None])

    def _streamed(self, made: MadeFile) -> StreamedFile:
        return self._deliveries.streamed(made.file, made.sha256)

    async def _each(
        self, function: Callable[[Any], BlockOutcome], tasks: Sequence[tuple[Any, Delivery]]
    ) -> list[BlockOutcome]:
        """What each block's job made, in order."""
        try:
            async with asyncio.TaskGroup() as group:
                made = [
                    group.create_task(self._one(number, function, *task))
                    for number, task in enumerate(tasks)
                ]
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None
        return [one.result() for one in made]

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
        # First: blocks and rounds end while a bucket is asked for what was said.
        stage, before, part = self._round, self._before, self._share
        ended, count, begun = self._done, self._count, list(self._begun.items())
        said = {number: delivery.progress() for number, delivery in begun}
        known = {number: report for number, report in said.items() if report is not None}
        stages = [f"block {n + 1} {text}" for n, (_, text) in sorted(known.items())[:3]]
        if count:
            done = ended + sum(share for share, _ in known.values())
            # A block that is begun again elsewhere says less than before.
            self._told = max(self._told, before + part * min(1.0, done / count))
            stage = f"{stage}, {ended} of {count} blocks done"
        elif (planned := self._planning.progress()) is not None:
            self._told = max(self._told, _PLANNED * planned[0])
        return self._told, "; ".join([stage, *stages])
