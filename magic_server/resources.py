"""Room on the disk and in memory: refused while it is short, taken again when it is back."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import psutil

from magic_core.errors import ConfigError, DiskFull, MemoryLow
from magic_server.store.blobs import DISK_RETRY_S

MEMORY_RETRY_S = 5.0
"""How long callers are asked to wait when memory is low."""
_CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True, slots=True)
class ResourceConfig:
    """What is kept free, so that what was accepted can be finished."""

    min_free_bytes: int = 256 << 20
    """Disk that uploads leave free: the database and the merges live of it."""
    min_available_bytes: int = 256 << 20
    """Memory below which nothing large is begun."""

    def __post_init__(self) -> None:
        if self.min_free_bytes < 0 or self.min_available_bytes < 0:
            raise ConfigError.field("resources", "min_free_bytes, min_available_bytes: 0 or more")


@dataclass(frozen=True, slots=True)
class Room:
    """What is free now, bytes."""

    disk: int
    memory: int


class Resources:
    """Measures the machine and refuses what does not fit."""

    def __init__(
        self,
        folder: Path,
        config: ResourceConfig,
        *,
        threads: Executor,
        measure: Callable[[Path], Room] | None = None,
    ) -> None:
        self._folder = folder
        self._config = config
        self._threads = threads
        self._measure = measure or measured_room

    def room(self) -> Room:
        """What is free now. Blocks for about a tenth of a millisecond."""
        return self._measure(self._folder)

    async def require(self, disk_bytes: int) -> None:
        """Raise DiskFull unless so much fits beside the reserve, MemoryLow when memory is short."""
        room = await asyncio.get_running_loop().run_in_executor(self._threads, self.room)
        if room.disk - disk_bytes < self._config.min_free_bytes:
            raise DiskFull(
                f"{disk_bytes} bytes do not fit: the server's disk has {room.disk} bytes free and "
                f"keeps {self._config.min_free_bytes}; try again once there is room",
                retry_after_s=DISK_RETRY_S,
            )
        if room.memory < self._config.min_available_bytes:
            raise MemoryLow(
                f"the server has {room.memory} bytes of memory left and begins nothing large below "
                f"{self._config.min_available_bytes}; try again",
                retry_after_s=MEMORY_RETRY_S,
            )


def measured_room(folder: Path) -> Room:
    """Free bytes of the folder's disk, and available memory of machine and control group."""
    return Room(shutil.disk_usage(folder).free, available_memory())


def available_memory(cgroup: Path = _CGROUP) -> int:
    """Bytes of memory this process may still take, a container's limit included."""
    free = psutil.virtual_memory().available
    try:
        limit = (cgroup / "memory.max").read_text().strip()
        if limit != "max":
            used = int((cgroup / "memory.current").read_text())
            free = min(free, max(0, int(limit) - used + _reclaimable(cgroup)))
    except (OSError, ValueError):
        pass  # no control group of version 2
    return free


def _reclaimable(cgroup: Path) -> int:
    """Bytes of file cache in a control group, which the kernel gives back when asked."""
    for line in (cgroup / "memory.stat").read_text().splitlines():
        key, _, value = line.partition(" ")
        if key == "inactive_file":
            return int(value)
    return 0
