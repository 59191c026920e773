"""A merge of several blocks as jobs of their own: one plans, two are each block's, one joins.

A block is first refined beside the sub-maps around it and then, shortly, beside its refined
neighbours. Within a round it needs nothing of other blocks, so they may run anywhere, in any order,
and again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magic_server.jobs.attempt import Attempt
from magic_server.jobs.delivery import Delivery, JobFile, SpacedReports
from magic_server.jobs.tasks import MergeOutcome, PlacedFiles, StoredSource, write_map
from magic_server.store.blob_store import StreamedFile

if TYPE_CHECKING:
    from magic_core.gaussians import GaussianCloud
    from magic_server.globalmap import MergeConfig
    from magic_server.globalmap.blocks import Block
    from magic_server.globalmap.parts import Parts


@dataclass(frozen=True, slots=True)
class PlanTask:
    """Sub-maps whose space is to be divided."""

    submaps: tuple[PlacedFiles, ...]
    config: MergeConfig
    delivery: Delivery
    """For the progress alone."""


@dataclass(frozen=True, slots=True)
class PlannedBlock:
    """A block, and which sub-maps it wants."""

    block: Block
    """Its keyframes are those of `submaps`, by index there."""
    submaps: tuple[int, ...]
    """Indices in the merge."""


@dataclass(frozen=True, slots=True)
class BlockTask:
    """One block to refine."""

    submaps: tuple[PlacedFiles, ...]
    """Those that it wants."""
    block: Block
    config: MergeConfig
    threads: int
    """Threads of the rasteriser; 0 for one per core."""
    delivery: Delivery


@dataclass(frozen=True, slots=True)
class TouchTask:
    """A refined block to refine once more beside its neighbours."""

    block: BlockTask
    """As in the first round, but for where it delivers."""
    own: StreamedFile
    neighbours: tuple[StreamedFile, ...]


@dataclass(frozen=True, slots=True)
class BlockOutcome:
    """A refined block: its Gaussians in the lossless layout."""

    file: JobFile
    sha256: str


@dataclass(frozen=True, slots=True)
class JoinTask:
    """Refined blocks that become one map."""

    blocks: tuple[StreamedFile, ...]
    delivery: Delivery


def plan_merge(task: PlanTask) -> tuple[PlannedBlock, ...]:
    """Divide space; one sub-map in memory at a time."""
    from magic_server.globalmap.blocks import places_of, plan_blocks
    from magic_server.globalmap.placement import placed_gaussians

    tell = SpacedReports(task.delivery)
    with task.delivery.working() as folder:
        attempt = Attempt(folder)
        sources = [StoredSource.of(item) for item in task.submaps]
        places, extents = [], []
        for number, source in enumerate(sources):
            share, stage = number / len(sources), "dividing space into blocks"
            attempt.report(share, stage)
            tell(share, stage)
            places += [dataclasses.replace(place, source=number) for place in places_of([source])]
            means = placed_gaussians(source).means
            extents.append((means.min(axis=0), means.max(axis=0)) if len(means) else None)
    blocks = plan_blocks(places, most_views=task.config.block_views)
    return tuple(_planned(block, extents) for block in blocks)


def _planned(block: Block, extents: list[tuple[np.ndarray, np.ndarray] | None]) -> PlannedBlock:
    """A block with the sub-maps that it wants alone."""
    wanted = {view.source for view in block.views}
    wanted |= {i for i, extent in enumerate(extents) if extent and block.touches(*extent)}
    submaps = sorted(wanted)
    place = {submap: i for i, submap in enumerate(submaps)}
    views = tuple(dataclasses.replace(view, source=place[view.source]) for view in block.views)
    return PlannedBlock(dataclasses.replace(block, views=views), tuple(submaps))


def refine_block(task: BlockTask) -> BlockOutcome:
    """Refine a block. A folder in which the same block was begun is taken up where it was."""
    config = _with_threads(task)
    from magic_server.globalmap import merge

    sources = [StoredSource.of(item) for item in task.submaps]
    with _at_work(task, sources, config, "refined") as (parts, report):
        merge.refine_block(task.block, parts, sources, config, progress=report)
        return _delivered(parts, task.delivery)


def touch_up_block(task: TouchTask) -> BlockOutcome:
    """Refine a block once more beside its neighbours; one of these in memory at a time."""
    block = task.block
    config = _with_threads(block)
    from magic_core.gaussians import codec
    from magic_server.globalmap import merge

    def cloud(file: StreamedFile) -> GaussianCloud:
        return codec.decode(b"".join(file.pieces()))

    sources = [StoredSource.of(item) for item in block.submaps]
    beside = " ".join(file.sha256 for file in (task.own, *task.neighbours))
    with _at_work(block, sources, config, f"touched {beside}") as (parts, report):
        merge.touch_up(
            block.block, cloud(task.own), map(cloud, task.neighbours), parts, sources, config,
            progress=report,
        )  # fmt: skip
        return _delivered(parts, block.delivery)


def _with_threads(task: BlockTask) -> MergeConfig:
    """The settings, with the threads that this machine has; before anything reads them."""
    threads = task.threads or os.cpu_count() or 1
    os.environ["MAGIC_THREADS"] = str(threads)
    config = task.config
    return config if config.threads else dataclasses.replace(config, threads=threads)


@contextlib.contextmanager
def _at_work(
    task: BlockTask, sources: list[StoredSource], config: MergeConfig, what: str
) -> Iterator[tuple[Parts, Callable[[float, str], None]]]:
    """The job's folder as one of parts, of which it makes the first, and whom to tell."""
    from magic_server.globalmap.parts import Parts, fingerprint_of

    with task.delivery.working() as folder:
        attempt, tell = Attempt(folder), SpacedReports(task.delivery)

        def report(share: float, stage: str) -> None:
            attempt.report(share, stage)
            tell(share, stage)

        name = f"{fingerprint_of(sources, config)} {_name_of(task.block)} {what}"
        yield Parts(folder, name), report


def _delivered(parts: Parts, delivery: Delivery) -> BlockOutcome:
    path = parts.path(0)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return BlockOutcome(delivery.deliver(path), digest)


def _name_of(block: Block) -> str:
    digest = hashlib.sha256(repr([(v.source, v.keyframe) for v in block.views]).encode())
    for corner in (block.low, block.high, block.reach_low, block.reach_high):
        digest.update(corner.astype("<f8").tobytes())
    return digest.hexdigest()


def join_blocks(task: JoinTask) -> MergeOutcome:
    """Write the map of refined blocks in every format, with one of them in memory at a time."""
    from magic_core.gaussians import codec

    with task.delivery.working() as folder:
        attempt = Attempt(folder)
        with tempfile.TemporaryDirectory(prefix="joining-", dir=folder) as temporary:
            paths = []
            for number, block in enumerate(task.blocks):
                attempt.report(number / len(task.blocks), "joining blocks")
                paths.append(Path(temporary) / f"{number}.mgsc")
                with paths[-1].open("wb") as file:
                    file.writelines(block.pieces())

            def pieces() -> Iterator[GaussianCloud]:
                return (codec.decode(path.read_bytes()) for path in paths)

            count = sum(len(cloud) for cloud in pieces())
            return write_map(pieces, count, folder=folder, attempt=attempt, delivery=task.delivery)
