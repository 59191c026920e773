"""`magic worker`: compute for the servers of a Dask cluster.

Start `dask scheduler` once, a worker on every machine that shall compute, and servers with
`magic serve --jobs.executor dask --jobs.scheduler tcp://HOST:8786`. All of them need the extra
`cluster`; workers read the server's blobs, in its data folder or, with the AWS credentials of their
own environment, in its bucket (docs/cluster.md). Whoever reaches the scheduler or a worker can run
code there: keep them in a network you trust, or give certificates.

Examples:
  magic worker tcp://10.0.0.5:8786
  magic worker tcp://10.0.0.5:8786 --data-dir /mnt/magic --processes 8
  magic worker tcp://10.0.0.5:8786 --resources gpu=1       # merges of --jobs.merge-resources gpu=1
  magic worker tls://10.0.0.5:8786 --tls.ca ca.pem --tls.certificate w.pem --tls.key w.key

SIGTERM or Ctrl-C ends it; what it was computing is begun again elsewhere. While the scheduler is
away it waits for it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import platform
import signal
import socket
import sys
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console
from magic_core import logs
from magic_core.errors import ConfigError
from magic_core.logs import LogConfig
from magic_core.tracing import TracingConfig
from magic_server.jobs.config import ClusterTls, check_scheduler, parse_resources

_SHOWN_VERSIONS = ("distributed", "numpy", "torch", "gtsam")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerCommand:
    """Options of `magic worker`."""

    scheduler: Positional[str]
    """The scheduler's address, tcp://host:8786 or tls://host:8786."""
    name: str = ""
    """What this worker is called, once in a cluster; default: host name and process id."""
    data_dir: Path | None = None
    """Where the server's data folder is mounted here; default: under the same path as there. With
    blobs in a bucket: a folder for what jobs read and make; default: a temporary one."""
    processes: int = 1
    """Jobs at a time, each in a process of its own."""
    threads: int = 1
    """Threads of the numerical libraries in each. Merges take jobs.merge_threads of the server, by
    default one per core."""
    resources: str = ""
    """What this worker offers beside, for instance gpu=1; the server's jobs.merge_resources asks
    for it."""
    host: str | None = None
    """Address of this machine that the scheduler can reach; default: the system chooses."""
    port: int = 0
    """Port on which the scheduler and servers reach this worker; 0 for any."""
    niceness: int = 5
    """Added to the jobs' niceness."""
    tls: ClusterTls = field(default_factory=ClusterTls)
    """Certificates for tls://."""
    logs: LogConfig = field(default_factory=LogConfig)
    tracing: TracingConfig = field(default_factory=TracingConfig)
    progress: Literal["text", "json"] = "text"
    """`json` prints a line on stdout whenever the worker has joined the cluster."""

    def __post_init__(self) -> None:
        check_scheduler(self.scheduler, self.tls, field="scheduler", tls="tls")
        parse_resources(self.resources, field="resources")
        if self.processes < 1 or self.threads < 1:
            raise ConfigError.field("processes", "processes and threads are at least 1")
        if not 0 <= self.port <= 65535:
            raise ConfigError.field("port", f"{self.port}: expected 0 to 65535")
        if self.data_dir is not None and not self.data_dir.is_dir():
            raise ConfigError.field(
                "data_dir",
                f"{self.data_dir} is no folder here; mount or make it first",
            )


def main(arguments: list[str]) -> int:
    """Work until told to stop; 0 after a clean end."""
    command = parse(WorkerCommand, arguments, prog="magic worker", description=__doc__ or "")
    logs.configure(command.logs)
    asyncio.run(_work(command))
    return 0


async def _work(command: WorkerCommand) -> None:
    from magic_server.jobs.cluster.slots import WorkerSettings
    from magic_server.jobs.cluster.worker import WorkerPlace, serve_jobs

    name = command.name or f"{socket.gethostname()}-{os.getpid()}"
    place = WorkerPlace(
        scheduler=command.scheduler,
        name=name,
        processes=command.processes,
        resources=parse_resources(command.resources, field="resources"),
        tls=command.tls,
        host=command.host,
        port=command.port,
    )
    settings = WorkerSettings(
        data_dir=None if command.data_dir is None else command.data_dir.absolute(),
        threads=command.threads,
        niceness=command.niceness,
        tracing=command.tracing,
    )
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await serve_jobs(
        place, settings, stop=stop, on_ready=lambda address: _announce(command, name, address)
    )
    # Dask's own tasks may not end where the scheduler vanished meanwhile; the jobs have ended.
    sys.stdout.flush()
    logging.shutdown()
    os._exit(0)


def _announce(command: WorkerCommand, name: str, address: str) -> None:
    """Say what joined the cluster, with what, and what it sees."""
    seen = {
        "worker": name,
        "address": address,
        "scheduler": command.scheduler,
        "processes": command.processes,
        "threads": command.threads,
        "resources": parse_resources(command.resources, field="resources"),
        "cores": len(os.sched_getaffinity(0)),
        "gpus": _gpus(),
        "data_dir": None if command.data_dir is None else str(command.data_dir),
        "versions": _versions(),
    }
    if command.progress == "json":
        sys.stdout.write(json.dumps(seen) + "\n")
        sys.stdout.flush()
        return
    offers = f", offers {command.resources}" if command.resources else ""
    versions = ", ".join(f"{package} {found}" for package, found in _versions().items())
    console.print(f"worker {name} at {address} serves {command.scheduler}", markup=False)
    console.print(
        f"  {command.processes} jobs at a time with {command.threads} threads each on "
        f"{seen['cores']} cores{offers}; NVIDIA GPUs: {', '.join(seen['gpus']) or 'none'}",
        markup=False,
    )
    console.print(f"  data folder: {command.data_dir or 'where the server has it'}", markup=False)
    console.print(f"  {versions}", markup=False)


def _versions() -> dict[str, str]:
    """Versions of what the results depend on, without loading any of it."""
    found = {"magic-slam": version("magic-slam"), "Python": platform.python_version()}
    for package in _SHOWN_VERSIONS:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found


def _gpus() -> list[str]:
    """Model names of the NVIDIA GPUs, as the driver lists them."""
    names = []
    for file in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        for line in file.read_text(errors="replace").splitlines():
            if line.startswith("Model:"):
                names.append(line.partition(":")[2].strip())
    return names
