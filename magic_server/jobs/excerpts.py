"""The job that makes the file of a part of a map."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magic_core.gaussians.region import Region
from magic_server.jobs.delivery import Delivery, JobFile
from magic_server.store.blob_store import StreamedFile

if TYPE_CHECKING:
    from magic_core.wire.records import MapFormat


@dataclass(frozen=True, slots=True)
class ExcerptTask:
    """What of which map, and where it goes."""

    source: StreamedFile
    """The map's lossless file."""
    region: Region | None
    max_gaussians: int
    kind: MapFormat
    delivery: Delivery


@dataclass(frozen=True, slots=True)
class ExcerptOutcome:
    """The file that was made."""

    file: JobFile
    sha256: str
    length: int
    gaussian_count: int
    full_gaussian_count: int
    """Gaussians that the map has in the region."""


def make_excerpt(task: ExcerptTask) -> ExcerptOutcome:
    """Write the file of a part of a map; the same part of the same map is the same file.

    A piece of the map is in memory at a time; its columns lie in the job's folder meanwhile.
    """
    from magic_core.gaussians import stream
    from magic_core.gaussians.columns import ColumnFile
    from magic_server.globalmap.excerpt import excerpt_of

    write = {
        "ply": stream.write_ply_pieces,
        "lossless": stream.write_lossless_pieces,
        "compact": stream.write_compact_pieces,
    }[task.kind]
    with task.delivery.working() as folder:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="making-", dir=folder) as temporary:
            making = Path(temporary)
            source = ColumnFile.unpacked(making / "map", task.source.pieces())
            excerpt = excerpt_of(
                source, making, region=task.region, max_gaussians=task.max_gaussians
            )
            partial, path = making / "file", folder / task.kind
            write(partial, excerpt.pieces)
            with partial.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            partial.replace(path)  # another try at this job writes the same
        length = path.stat().st_size
        delivered = task.delivery.deliver(path)
    count = len(excerpt.columns)
    return ExcerptOutcome(delivered, digest, length, count, excerpt.full_count)
