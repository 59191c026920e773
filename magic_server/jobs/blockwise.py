"""A merge of several blocks as jobs of their own: one plans, each round has one of each block, one
joins.

Within a round a block needs nothing of the others, so they may run anywhere, in any order, and
again (magic_server/globalmap/rounds.py).
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magic_server.jobs.attempt import Attempt
from magic_server.jobs.delivery import Delivery, JobFile, SpacedReports, spaced_keeping
from magic_server.jobs.tasks import MergeOutcome, PlacedFiles, StoredSource, write_map
from magic_server.store.blob_store import StreamedFile

if TYPE_CHECKING:
    from magic_core.gaussians import GaussianCloud
    from magic_server.globalmap import MergeConfig
    from magic_server.globalmap.blocks import Block
    from magic_server.globalmap.parts import Parts
    from magic_server.globalmap.rounds import Progress


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
    until: float
    """The share of the schedule at which it ends."""


@dataclass(frozen=True, slots=True)
class RefinedBlocks:
    """What the blocks of a round made, as far as a job wants it."""

    own: Mapping[int, StreamedFile]
    """Of each block its own Gaussians, in the lossless layout."""
    handed: Sequence[StreamedFile]
    """What others made of them (`consensus.encode`)."""


@dataclass(frozen=True, slots=True)
class BesideTask:
    """A block to refine further beside its neighbours."""

    block: BlockTask
    number: int
    begin: float
    """The share of the schedule at which it begins."""
    around: RefinedBlocks
    """This block and those near it after the round before."""


@dataclass(frozen=True, slots=True)
class MadeFile:
    """A file of a job's that other jobs read."""

    file: JobFile
    sha256: str


@dataclass(frozen=True, slots=True)
class BlockOutcome:
    """What a block's job made."""

    own: MadeFile
    """Its Gaussians in the lossless layout."""
    handed: MadeFile | None
    """What it made of others' (`consensus.encode`); None where it saw none."""


@dataclass(frozen=True, slots=True)
class JoinTask:
    """Blocks after the last round, which become one map."""

    blocks: tuple[RefinedBlocks, ...]
    """Each with what others made of it."""
    config: MergeConfig
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
    from magic_server.globalmap import rounds

    sources = [StoredSource.of(item) for item in task.submaps]

    def refine(parts: Parts, report: Progress) -> None:
        rounds.refine_alone(task.block, parts, sources, config, until=task.until, progress=report)

    return _outcome(task, 0, _named(task.block, sources, config, f"alone {task.until}"), refine)


def refine_block_beside(task: BesideTask) -> BlockOutcome:
    """Refine a block further; taken up where it was like the first round."""
    block, number = task.block, task.number
    config = _with_threads(block)
    from magic_server.globalmap import rounds

    sources = [StoredSource.of(item) for item in block.submaps]
    files = chain(task.around.own.values(), task.around.handed)
    what = " ".join([f"beside {task.begin} {block.until}", *(file.sha256 for file in files)])

    def refine(parts: Parts, report: Progress) -> None:
        rounds.refine_beside(
            block.block, _agreed(task.around), parts, sources, config, number=number,
            span=(task.begin, block.until), progress=report,
        )  # fmt: skip

    return _outcome(block, number, _named(block.block, sources, config, what), refine)


def _agreed(refined: RefinedBlocks) -> Iterator[tuple[int, GaussianCloud]]:
    """The blocks as all agree on them, one at a time."""
    from magic_core.gaussians import codec
    from magic_server.globalmap import consensus, rounds

    def content(file: StreamedFile) -> bytes:
        return b"".join(file.pieces())

    numbers = list(refined.own)
    handed = (consensus.decode(content(file), owners=numbers) for file in refined.handed)
    return rounds.agreed_blocks(
        numbers,
        lambda number: codec.decode(content(refined.own[number])),
        chain.from_iterable(handed),
    )


def _with_threads(task: BlockTask) -> MergeConfig:
    """The settings, with the threads that this machine has; before anything reads them."""
    threads = task.threads or os.cpu_count() or 1
    os.environ["MAGIC_THREADS"] = str(threads)
    config = task.config
    return config if config.threads else dataclasses.replace(config, threads=threads)


def _outcome(
    task: BlockTask, number: int, name: str, refine: Callable[[Parts, Progress], None]
) -> BlockOutcome:
    """What a block's job of this name makes, or made when it was tried before."""
    from magic_server.globalmap.parts import Parts, files_of

    if (before := task.delivery.concluded(name)) is not None:
        return _block_outcome([MadeFile(file, file.sha256) for file in before])
    with task.delivery.working() as folder:
        attempt, tell = Attempt(folder), SpacedReports(task.delivery)

        def report(share: float, stage: str) -> None:
            attempt.report(share, stage)
            tell(share, stage)

        saved = spaced_keeping(task.delivery, lambda: files_of(folder))
        parts = Parts(folder, name, saved=saved)
        refine(parts, report)
        paths = [parts.path(number), parts.guests_path(number)]
        made = [_made(path, task.delivery) for path in paths if path.is_file()]
    task.delivery.conclude(name, [one.file for one in made])
    return _block_outcome(made)


def _block_outcome(made: Sequence[MadeFile]) -> BlockOutcome:
    own, *handed = made
    return BlockOutcome(own, handed[0] if handed else None)


def _made(path: Path, delivery: Delivery) -> MadeFile:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return MadeFile(delivery.deliver(path), digest)


def _named(block: Block, sources: list[StoredSource], config: MergeConfig, what: str) -> str:
    """A name that no job with another outcome has."""
    from magic_server.globalmap.parts import fingerprint_of, rounded

    digest = hashlib.sha256(repr(block.views).encode())
    for corner in (block.low, block.high, block.reach_low, block.reach_high):
        digest.update(rounded(corner, 6))
    return f"{fingerprint_of(sources, config)} {digest.hexdigest()} {what}"


def join_blocks(task: JoinTask) -> MergeOutcome:
    """Write the map of refined blocks in every format, with one of them in memory at a time."""
    from magic_core.gaussians import codec
    from magic_server.globalmap import rounds

    with task.delivery.working() as folder:
        attempt = Attempt(folder)
        with tempfile.TemporaryDirectory(prefix="joining-", dir=folder) as temporary:
            paths, count = [], 0
            for number, block in enumerate(task.blocks):
                attempt.report(number / len(task.blocks), "joining blocks")
                ((_, cloud),) = _agreed(block)
                cloud = rounds.visible(cloud, task.config)
                count += len(cloud)
                paths.append(Path(temporary) / f"{number}.mgsc")
                paths[-1].write_bytes(codec.encode_lossless(cloud))

            def pieces() -> Iterator[GaussianCloud]:
                return (codec.decode(path.read_bytes()) for path in paths)

            return write_map(pieces, count, folder=folder, attempt=attempt, delivery=task.delivery)
