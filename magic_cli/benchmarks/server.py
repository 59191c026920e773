"""`magic bench server`: many agents submit sub-maps at once to a server on this machine.

A recording of the generated flat is replayed by agents that only send, into a server in a process
of its own that searches, verifies and solves as always. Reports the rate against plain synced
writes of the same bytes to the same disk, the times of calls under that load, how the server's
memory grows, and how often its event loop stood still for more than 50 ms. Ctrl-C, SIGTERM or
`--seconds` end it early, with the figures so far.

Examples:
  magic bench server --submaps 200
  magic bench server --seconds 300 --json
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError, Unavailable

STOP_TIMEOUT_S = 60.0
SAID_EVERY_S = 10.0


@dataclass(frozen=True, slots=True)
class ServerBenchmark:
    """Options of `magic bench server`."""

    agents: int = 32
    """Agents that submit at the same time."""
    submaps: int = 2000
    """Sub-maps they submit together."""
    folder: Path | None = None
    """Where they are stored and the plain files are written; a temporary folder by default."""
    seconds: float = 0.0
    """No more sub-maps are submitted after this long; 0 for no limit."""
    json: bool = False
    """Print one JSON object as the last line."""

    def __post_init__(self) -> None:
        if not 1 <= self.agents <= 1000:
            raise ConfigError.field("agents", f"{self.agents}: expected 1 to 1000")
        if self.submaps < self.agents:
            raise ConfigError.field(
                "submaps", f"{self.submaps}: expected at least one for each of {self.agents} agents"
            )
        if not 0 <= self.seconds < float("inf"):
            raise ConfigError.field("seconds", f"{self.seconds}: expected 0 or more")


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its tables."""
    config = parse(ServerBenchmark, arguments, prog="magic bench server", description=__doc__ or "")
    if config.folder is not None:
        config.folder.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="magic-bench-", dir=config.folder))
    try:
        result = _measured(config, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    _show(result)
    if config.json:
        print_json(result)
    return 0


def _measured(config: ServerBenchmark, folder: Path) -> dict:
    from magic_cli.benchmarks.server_load import Load, plain_write, run_load
    from magic_cli.benchmarks.server_recording import record

    said = Said()
    said("recording")
    recording = record(lambda share: said(f"recording: {share:.0%}"))
    child = _start(folder / "store")
    try:
        address = _line_of(child)["address"]

        async def loaded() -> Load:
            async with _told_to_stop(config.seconds) as stop:
                return await run_load(
                    address,
                    recording,
                    agents=config.agents,
                    submaps=config.submaps,
                    server_pid=child.pid,
                    progress=lambda load: said(load.line()),
                    stop=stop,
                )

        load = asyncio.run(loaded())
    finally:
        seen = _stopped(child)
    if not load.submaps:
        raise Unavailable("no sub-map was stored before the end; give it more time")
    said("writing the same bytes to plain files", at_once=True)
    each = load.sent_bytes // load.submaps
    disk_s = plain_write(folder / "plain", [each] * load.submaps)
    rate, disk_rate = (load.sent_bytes / 1e6 / seconds for seconds in (load.seconds, disk_s))
    return {
        "agents": config.agents,
        "submaps": load.submaps,
        "complete": load.submaps == config.submaps,
        "mb_per_s": rate,
        "disk_mb_per_s": disk_rate,
        "ratio": rate / disk_rate,
        "rpc_ms": load.percentiles_ms(),
        "rss_growth_bytes_per_submap": load.growth_bytes_per_submap(),
        "loop_stalls_over_50ms": seen["stalls"],
        "longest_stall_ms": seen["longest_ms"],
        "mb_per_submap": each / 1e6,
        "seconds": load.seconds,
        "rss_mb": load.memory[-1][1] / 1e6,
        "server_cpu_s": load.server_cpu_s,
        "client_cpu_s": load.client_cpu_s,
        "stalls": seen["worst"],
    }


class Said:
    """Says how far it is: now and then, because it may end in a log."""

    def __init__(self) -> None:
        self._last_s = float("-inf")

    def __call__(self, text: str, *, at_once: bool = False) -> None:
        if at_once or time.monotonic() - self._last_s >= SAID_EVERY_S:
            self._last_s = time.monotonic()
            console.print(text)


@contextlib.asynccontextmanager
async def _told_to_stop(seconds: float) -> AsyncIterator[asyncio.Event]:
    """Set by SIGINT, SIGTERM, and after so many seconds where there is a limit."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    numbers = (signal.SIGINT, signal.SIGTERM)
    for number in numbers:
        loop.add_signal_handler(number, stop.set)
    timer = loop.call_later(seconds, stop.set) if seconds else None
    try:
        yield stop
    finally:
        if timer is not None:
            timer.cancel()
        for number in numbers:
            loop.remove_signal_handler(number)


def _start(store: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "magic_cli.benchmarks.server_child", str(store)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the benchmark, which then stops the server
    )


def _stopped(child: subprocess.Popen[str]) -> dict:
    """Stop the server as an operator would; what it says about its event loop."""
    child.terminate()
    try:
        output, _ = child.communicate(timeout=STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        raise Unavailable(f"the server did not stop within {STOP_TIMEOUT_S:g} s") from None
    return json.loads(output.splitlines()[-1])


def _line_of(child: subprocess.Popen[str]) -> dict:
    assert child.stdout is not None
    line = child.stdout.readline()
    if not line:
        raise Unavailable("the server ended before it was ready; its message is above")
    return json.loads(line)


def _show(result: dict) -> None:
    rows = [
        [name, f"{times['p50']:.1f} ms", f"{times['p99']:.1f} ms", str(times["calls"])]
        for name, times in result["rpc_ms"].items()
    ]
    console.print(table("Calls under load", ["call", "p50", "p99", "calls"], rows))
    facts = [
        ["sustained", f"{result['mb_per_s']:.1f} MB/s"],
        ["plain synced writes", f"{result['disk_mb_per_s']:.1f} MB/s"],
        ["ratio", f"{result['ratio']:.2f}"],
        ["memory per sub-map", f"{result['rss_growth_bytes_per_submap'] / 1e3:.1f} kB"],
        ["event loop above 50 ms", str(result["loop_stalls_over_50ms"])],
    ]
    title = f"{result['submaps']} sub-maps of {result['mb_per_submap']:.2f} MB from "
    console.print(table(title + f"{result['agents']} agents", ["", ""], facts))
