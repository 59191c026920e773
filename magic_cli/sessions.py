"""`magic sessions list|show|delete|export|import`: what a server or its folder stores.

Examples:
  magic sessions list
  magic sessions show office --server robots.example:50051
  magic sessions export office --out office.tar
  magic sessions import office.tar --data-dir /srv/magic     # no server running there
  magic sessions delete sessions/office/agents/robot_1 --force

A session is one portable archive (docs/wire-format.md): import checks every byte and rule again.
"""

from __future__ import annotations

import asyncio
import os
import sys
import uuid
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError, NotFound
from magic_core.wire import names, records
from magic_core.wire.credentials import ClientCredentials
from magic_core.wire.header_check import request_id_problem

if TYPE_CHECKING:
    from magic_cli.session_shelf import Shelf

PIECE_BYTES = 1 << 20
ACTIONS = ("list", "show", "delete", "export", "import")


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where the sessions are."""

    server: str = "127.0.0.1:50051"
    """Address of the server."""
    data_dir: Path | None = None
    """Folder of a store that no server has open, instead of a server."""
    credentials: ClientCredentials = field(default_factory=ClientCredentials)
    """How to connect to the server."""
    timeout_s: float = 3600.0
    """Longest export or import, seconds."""
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ListCommand(Place):
    """Options of `magic sessions list`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShowCommand(Place):
    """Options of `magic sessions show`."""

    name: Positional[str]
    """The session."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeleteCommand(Place):
    """Options of `magic sessions delete`."""

    name: Positional[str]
    """The session; on a server also the resource name of an agent or a sub-map."""
    force: bool = False
    """Delete although an agent has not finished."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportCommand(Place):
    """Options of `magic sessions export`."""

    name: Positional[str]
    """The session."""
    out: Path | None = None
    """File to write; NAME.tar by default."""
    overwrite: bool = False
    """Replace the file where there is one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportCommand(Place):
    """Options of `magic sessions import`."""

    archive: Positional[Path]
    """File that `magic sessions export` wrote."""
    request_id: str = ""
    """Name of this import: repeated with the same archive it gets the first answer. By default a
    new one for each run, which it keeps while it tries again."""


COMMANDS: dict[str, type[Place]] = {
    "list": ListCommand,
    "show": ShowCommand,
    "delete": DeleteCommand,
    "export": ExportCommand,
    "import": ImportCommand,
}


def main(arguments: list[str]) -> int:
    """Run one action; 0 when it was done."""
    if arguments[:1] in (["-h"], ["--help"]):
        print(f"usage: magic sessions {{{','.join(ACTIONS)}}} [options]\n\n{__doc__}")
        return 0
    if not arguments or arguments[0] not in COMMANDS:
        print(f"magic sessions: expected one of {', '.join(ACTIONS)}", file=sys.stderr)
        return 2
    action, *rest = arguments
    command = parse(
        COMMANDS[action], rest, prog=f"magic sessions {action}", description=__doc__ or ""
    )
    result = asyncio.run(_done(command))
    if command.json:
        print_json(result)
    return 0


async def _done(command: Place) -> dict[str, Any]:
    from magic_cli.session_shelf import opened

    async with opened(command) as shelf:
        match command:
            case ShowCommand(name=name):
                return await _show(shelf, _session_id(name))
            case DeleteCommand(name=name, force=force):
                deleted = await shelf.delete(name, force=force)
                text = f"{deleted.submap_count} sub-maps, {deleted.freed_bytes / 1e6:.1f} MB"
                console.print(f"Deleted {name}: {text}", markup=False)
                return {"deleted": name, "submaps": deleted.submap_count,
                        "freed_bytes": deleted.freed_bytes}  # fmt: skip
            case ExportCommand(name=name, out=out, overwrite=overwrite):
                session = _session_id(name)
                path = _place(out or Path(f"{session}.tar"), overwrite=overwrite)
                size = await _write(shelf.export(session), path)
                console.print(f"Written: {path}, {size / 1e6:.1f} MB", soft_wrap=True, markup=False)
                return {"session": session, "archive": str(path), "bytes": size}
            case ImportCommand(archive=archive, request_id=request_id):
                pieces = ArchiveFile(_existing(archive))
                info = await shelf.import_(pieces, request_id=_chosen_or_new(request_id))
                console.print(f"Imported {info.name}: {info.submap_count} sub-maps", markup=False)
                return _session_json(info)
            case _:
                return _list(await shelf.list())


def _session_id(name: str) -> str:
    """A session's id, given as such or as a resource name."""
    full = name if name.startswith("sessions/") else names.session_name(name)
    return names.parse_session(full)


def _list(sessions: tuple[records.SessionInfo, ...]) -> dict[str, Any]:
    columns = ["session", "agents", "sub-maps", "MB", "revision", "open loops", "begun"]
    rows = [
        [
            info.name.removeprefix("sessions/"),
            str(info.agent_count),
            str(info.submap_count),
            f"{info.stored_bytes / 1e6:.1f}",
            str(info.revision),
            str(info.pending_loops),
            f"{info.created_at:%Y-%m-%d %H:%M}",
        ]
        for info in sessions
    ]
    console.print(table(f"{len(sessions)} sessions", columns, rows))
    return {"sessions": [_session_json(info) for info in sessions]}


async def _show(shelf: Shelf, session: str) -> dict[str, Any]:
    info, agents = await shelf.show(session)
    _list((info,))
    rows = [
        [
            agent.name.rpartition("/")[2],
            agent.state.lower(),
            str(agent.submap_count),
            f"{agent.last_seen_at:%Y-%m-%d %H:%M:%S}",
        ]
        for agent in agents
    ]
    console.print(table("Agents", ["agent", "state", "sub-maps", "last seen"], rows))
    return _session_json(info) | {
        "agents": [
            {
                "name": agent.name,
                "state": agent.state,
                "submaps": agent.submap_count,
                "next_submap_index": agent.next_submap_index,
                "last_seen_at": agent.last_seen_at.isoformat(),
            }
            for agent in agents
        ]
    }


def _session_json(info: records.SessionInfo) -> dict[str, Any]:
    return {
        "name": info.name,
        "created_at": info.created_at.isoformat(),
        "descriptor_model_id": info.descriptor_model_id,
        "descriptor_dimension": info.descriptor_dimension,
        "agent_count": info.agent_count,
        "submap_count": info.submap_count,
        "stored_bytes": info.stored_bytes,
        "revision": info.revision,
        "pending_loops": info.pending_loops,
    }


def _chosen_or_new(request_id: str) -> str:
    if request_id and (problem := request_id_problem(request_id)):
        raise ConfigError.field("request_id", problem)
    return request_id or uuid.uuid4().hex


def _place(path: Path, *, overwrite: bool) -> Path:
    """Where to write; ConfigError where a file is that may not be replaced."""
    if path.exists() and not overwrite:
        raise ConfigError.field("out", f"{path} exists; add --overwrite to replace it")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


async def _write(pieces: AsyncIterator[bytes], path: Path) -> int:
    """Write an archive beside its place and move it there once it is whole."""
    partial = path.with_name(f".{path.name}.partial")
    size = 0
    try:
        with partial.open("wb") as file:
            async for piece in pieces:
                await asyncio.to_thread(file.write, piece)
                size += len(piece)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return size


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise NotFound(f"{path}: no such file")
    return path


@dataclass(frozen=True, slots=True)
class ArchiveFile:
    """The pieces of an archive; it can be read any number of times."""

    path: Path

    async def __aiter__(self) -> AsyncIterator[bytes]:
        with self.path.open("rb") as file:
            while piece := await asyncio.to_thread(file.read, PIECE_BYTES):
                yield piece
