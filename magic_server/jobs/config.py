"""Settings of the jobs: which engine runs them, and with what."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from magic_core.errors import ConfigError

SCHEMES = ("tcp://", "tls://")


@dataclass(frozen=True, slots=True)
class ClusterTls:
    """Certificates for talking to a Dask scheduler at tls://, all PEM, all three or none."""

    ca: Path | None = None
    """The authority that signed the certificates of scheduler, workers and servers."""
    certificate: Path | None = None
    """This process's own certificate."""
    key: Path | None = None
    """The certificate's private key."""

    def __post_init__(self) -> None:
        given = [item is not None for item in (self.ca, self.certificate, self.key)]
        if any(given) and not all(given):
            raise ConfigError.field(
                "tls", "a Dask cluster wants ca, certificate and key; give all three"
            )

    @property
    def enabled(self) -> bool:
        """Whether there are certificates."""
        return self.ca is not None


@dataclass(frozen=True, slots=True)
class JobConfig:
    """Where and how heavy work runs."""

    executor: Literal["pool", "dask"] = "pool"
    """`pool` runs it in processes here, `dask` on the workers of a Dask cluster."""
    workers: int = 2
    """pool: processes; registration, pose graphs and merging share them."""
    threads_per_worker: int = 1
    """pool: threads of the numerical libraries in each."""
    merge_threads: int = 0
    """Threads of a merge's rasteriser; 0 takes one per core."""
    merge_blocks: int = 0
    """Blocks of one merge that are refined at the same time; 0 is one in a pool, whose memory and
    cores it shares with all else, and as many as there are workers on a cluster."""
    niceness: int = 5
    """pool: added to the workers' niceness, so that requests are answered while they compute."""
    scheduler: str = ""
    """dask: the scheduler's address, tcp://host:8786 or tls://host:8786."""
    tls: ClusterTls = field(default_factory=ClusterTls)
    """dask: certificates for tls://."""
    in_flight: int = 64
    """dask: most jobs handed to the scheduler at a time, and never more than twice what its workers
    can run at once; further ones wait here, the urgent ones in front."""
    merge_resources: str = ""
    """dask: resources that a worker must offer to be given a merge, for instance gpu=1."""
    connect_timeout_s: float = 10.0
    """dask: how long someone who waits for an answer waits for a scheduler and workers, seconds.
    Everything else waits until they are there."""

    def __post_init__(self) -> None:
        if self.workers < 1 or self.threads_per_worker < 1 or self.merge_threads < 0:
            raise ConfigError.field("jobs", "workers and threads_per_worker are at least 1")
        if self.merge_blocks < 0:
            raise ConfigError.field("jobs.merge_blocks", f"{self.merge_blocks}: expected 0 or more")
        if self.in_flight < 1:
            raise ConfigError.field("jobs.in_flight", f"{self.in_flight}: expected at least 1")
        if not 0.0 < self.connect_timeout_s <= 3600.0:
            raise ConfigError.field(
                "jobs.connect_timeout_s", f"{self.connect_timeout_s}: expected up to 3600 seconds"
            )
        parse_resources(self.merge_resources, field="jobs.merge_resources")
        if self.executor == "dask":
            check_scheduler(self.scheduler, self.tls, field="jobs.scheduler", tls="jobs.tls")
        elif self.scheduler or self.merge_resources or self.tls.enabled:
            raise ConfigError.field(
                "jobs",
                "scheduler, tls and merge_resources are for a Dask cluster; give "
                "jobs.executor dask as well, or leave them out",
            )


def check_scheduler(address: str, certificates: ClusterTls, *, field: str, tls: str) -> None:
    """Raise ConfigError unless an address is one of a scheduler and fits the certificates.

    `field` and `tls` are what the settings are called where they were given.
    """
    host, _, port = address.partition("://")[2].rpartition(":")
    known = address.startswith(SCHEMES) and host and port.isascii() and port.isdigit()
    if not known or not 0 < int(port) <= 65535:
        raise ConfigError.field(
            field, f"{address!r}: expected tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler"
        )
    if address.startswith("tls://") and not certificates.enabled:
        raise ConfigError.field(field, f"{address}: needs {tls}.ca, .certificate and .key")
    if address.startswith("tcp://") and certificates.enabled:
        raise ConfigError.field(
            field, f"{address}: with {tls}.* the scheduler is at tls://, not at tcp://"
        )


def parse_resources(text: str, *, field: str) -> dict[str, float]:
    """`gpu=1,memory_gb=20` as a mapping. Raises ConfigError for anything else."""
    resources = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, amount = part.partition("=")
        try:
            value = float(amount)
        except ValueError:
            value = math.nan
        if not name.isidentifier() or not (0.0 < value < math.inf):
            raise ConfigError.field(field, f"{part!r}: expected NAME=AMOUNT, for instance gpu=1")
        resources[name] = value
    return resources
