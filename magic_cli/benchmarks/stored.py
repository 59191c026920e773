"""The sub-maps of a finished run, read from the store in its folder."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from magicslam.v1 import submap_pb2

from magic_core.errors import DataError
from magic_core.evaluation import RunFolder
from magic_core.wire import names

if TYPE_CHECKING:
    from magic_server.jobs.tasks import StoredSource


def is_run_folder(path: Path) -> bool:
    """Whether a folder is what `magic run` leaves behind."""
    folder = RunFolder(path)
    return folder.components_path.is_file() and folder.server_folder.is_dir()


def stored_sources(folder: RunFolder) -> list[StoredSource]:
    """The sub-maps of a run's largest component, where its pose graph put them."""
    if not is_run_folder(folder.path):
        raise DataError(f"{folder.path}: no components.json and server/ in it; is it a run folder?")
    return asyncio.run(_sources(folder))


async def _sources(folder: RunFolder) -> list[StoredSource]:
    from magic_core.wire.submap import decode_odometry
    from magic_server.jobs.tasks import PlacedFiles, StoredSource
    from magic_server.seams import seams_of_anchors
    from magic_server.store import Store

    components = folder.read_components()
    main = components.largest()
    anchors = {
        name: anchor.world_from_anchor
        for name, anchor in components.anchors.items()
        if anchor.component == main
    }
    stored = {}
    with ThreadPoolExecutor(2) as threads:
        async with Store(folder.server_folder, threads) as store:
            for name in anchors:
                session, agent, index = names.parse_submap(name)
                row = await store.agents.session(session)
                stored[name] = await store.submaps.stored(row, agent, index)
    headers = {
        name: submap_pb2.SubmapHeader.FromString(item.header) for name, item in stored.items()
    }
    seams = seams_of_anchors(anchors, lambda name: decode_odometry(headers[name]))
    return [
        StoredSource.of(PlacedFiles(name, stored[name], anchors[name], seams[name]))
        for name in anchors
    ]
