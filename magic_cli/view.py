"""`magic view`: see a session in the browser, live from a server or from a finished run.

Examples:
  magic view runs/demo                     # a run folder: opens its stored session
  magic view 192.168.1.20:50051            # a server, while agents run
  magic view 127.0.0.1:50051 --session flat --port 9000
  magic view 127.0.0.1:50051 --no-page --rerun flat.rrd   # only write what happens, for Rerun
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import signal
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from magic_agent.client import ClientConfig, MagicClient
from magic_cli import processes
from magic_cli.options import parse
from magic_cli.output import console
from magic_core.errors import ConfigError, DeadlineExceeded, InvalidInput, NotFound, Unavailable
from magic_core.wire import ClientCredentials

if TYPE_CHECKING:
    from magic_cli.viewer.feed import Draw
    from magic_cli.viewer.model import SessionView

_START_TIMEOUT_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCommand:
    """Options of `magic view`."""

    target: Annotated[str, tyro.conf.Positional]
    """A run folder, or the address of a server."""
    session: str | None = None
    """Which session; the newest unless given."""
    host: str = "127.0.0.1"
    """Where the page is served; 0.0.0.0 lets the whole network look."""
    port: int = 8080
    """Port of the page; the next free one where it is taken."""
    page: bool = True
    """Serve the page."""
    rerun: Path | None = None
    """Write what happens to this Rerun recording (.rrd) too; needs the extra `rerun`."""
    max_splats: int = 1_000_000
    """Gaussians sent to the browser at most; of more, neighbours that are alike are merged."""
    interval_s: float = 0.5
    """Time between two looks at the server, seconds."""
    credentials: ClientCredentials = field(default_factory=ClientCredentials)
    """Encryption and token of the connection to the server."""
    progress: Literal["text", "json"] = "text"
    """`json` prints one line with the page's address once it is served."""


def main(arguments: list[str]) -> int:
    """Serve the page until interrupted."""
    command = parse(ViewCommand, arguments, prog="magic view", description=__doc__ or "")
    logging.basicConfig(level=logging.WARNING, format="%(name)s %(levelname)s %(message)s")
    with contextlib.suppress(asyncio.CancelledError):
        asyncio.run(_view(command))
    return 0


async def _view(command: ViewCommand) -> None:
    from magic_cli.viewer.feed import Feed
    from magic_cli.viewer.recording import require_rerun

    _check(command)
    if command.rerun is not None:
        require_rerun(command.rerun)
    task = asyncio.current_task()
    assert task is not None
    for number in (signal.SIGINT, signal.SIGTERM):  # so that a server of our own ends with us
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    settings = ClientConfig(credentials=command.credentials)
    async with _address(command.target) as address, MagicClient(address, settings) as client:
        with contextlib.ExitStack() as stack:
            draw, page = _drawers(command, stack)
            feed = Feed(client, session=command.session, draw=draw, interval_s=command.interval_s)
            _say(command, page)
            try:
                await feed.run()
            finally:
                if command.rerun is not None:
                    with contextlib.suppress(Unavailable, DeadlineExceeded, NotFound):
                        await feed.complete()


def _check(command: ViewCommand) -> None:
    if command.max_splats < 1 or command.interval_s <= 0:
        raise InvalidInput.field("max_splats, interval_s", "expected positive numbers")
    if not command.page and command.rerun is None:
        raise ConfigError("--no-page: nothing to do; name a recording with --rerun FILE")


def _drawers(command: ViewCommand, stack: contextlib.ExitStack) -> tuple[Draw, str | None]:
    """What draws each new state, closed by the stack, and the page's address where there is one."""
    drawers: list[Draw] = []
    address = None
    if command.page:
        from magic_cli.viewer.page import Page

        page = Page(host=command.host, port=command.port, max_splats=command.max_splats)
        stack.callback(page.close)
        drawers.append(page.update)
        address = page.address
    if command.rerun is not None:
        from magic_cli.viewer.recording import Recording

        recording = Recording(command.rerun, max_points=command.max_splats)
        stack.callback(recording.close)
        drawers.append(recording.update)

    def draw(view: SessionView) -> None:
        for drawer in drawers:
            drawer(view)

    return draw, address


async def record(folder: Path, path: Path, *, max_points: int) -> None:
    """Write the stored session of a run folder to a Rerun recording."""
    from magic_cli.viewer.feed import Feed
    from magic_cli.viewer.recording import Recording, require_rerun

    require_rerun(path, overwrite=True)
    run = _run_folder(str(folder))
    async with _address(str(run)) as address, MagicClient(address) as client:
        with contextlib.closing(Recording(path, max_points=max_points)) as recording:
            feed = Feed(client, session=None, draw=recording.update, interval_s=1.0)
            await feed.complete()


@contextlib.asynccontextmanager
async def _address(target: str) -> AsyncIterator[str]:
    """The server to watch: the one named, or one of our own over a run folder's store."""
    folder = _run_folder(target)
    if folder is None:
        yield target
        return
    child = await processes.start(
        "server",
        ["serve", "--data-dir", str(folder / "server"), "--port", "0", "--progress", "json"],
        log=folder / "server" / "view-log.txt",
        threads=1,
    )
    try:
        yield (await processes.wait_ready(child, timeout_s=_START_TIMEOUT_S))["target"]
    finally:
        await processes.stop(child)


def _run_folder(target: str) -> Path | None:
    """The run folder, or None for an address; InvalidInput for what is neither."""
    folder = Path(target)
    if not folder.exists() and ":" in target:
        return None
    if not (folder / "server" / "magic.sqlite").is_file():
        raise InvalidInput.field(
            "target",
            f"{target}: neither a run folder (no server/magic.sqlite) nor an address "
            "like 127.0.0.1:50051",
        )
    return folder


def _say(command: ViewCommand, address: str | None) -> None:
    if command.progress == "json":
        sys.stdout.write(json.dumps({"ready": True, "page": address}) + "\n")
        sys.stdout.flush()
    elif address is not None:
        console.print(f"Open {address} in a browser. Ctrl-C ends it.")
    else:
        console.print(f"Writing {command.rerun}. Ctrl-C ends it.", markup=False)
