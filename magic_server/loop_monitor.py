"""Watches that the event loop never stands still.

A heartbeat runs in the loop every few milliseconds. When one comes late, the gap is a stall of the
loop, less the time in which the machine gave its processors to others: on Linux the scheduler says
how long each thread was ready to run but did not, and the loop can be held up by its own thread or
by one that was put aside while holding the interpreter lock. Nor is it a stall when the process as
a whole was stopped: no thread of it came to run, and no processor time was used.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import sys
import threading
import time
import traceback
from dataclasses import dataclass
from types import FrameType
from typing import Self

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Stall:
    """One time in which the loop did not run."""

    at_s: float
    """When it was over, seconds since the monitor began."""
    seconds: float
    """How long, less `waited_s`."""
    gap_s: float
    """Time between two heartbeats, less the interval."""
    waited_s: float
    """Share of it in which a thread of this process, or the whole machine, waited for a processor
    (0 where unknown)."""
    cpu_s: float
    """Processor time the loop's own thread used."""
    gc_s: float
    """Share of it spent collecting garbage."""
    stack: str
    """What the loop's thread was doing, where it was seen doing anything."""


class LoopMonitor:
    """Records stalls of the running event loop.

        async with LoopMonitor(threshold_s=0.05) as monitor:
            ...
        assert not monitor.stalls

    Only the longest 100 stalls are kept; `count` counts all.
    """

    def __init__(self, *, threshold_s: float = 0.05, interval_s: float = 0.005) -> None:
        self.threshold_s = threshold_s
        self.stalls: list[Stall] = []
        self.count = 0
        self.beats = 0
        self.longest_s = 0.0
        self._interval_s = interval_s
        self._task: asyncio.Task[None] | None = None
        self._watcher: threading.Thread | None = None
        self._stop = threading.Event()
        self._thread_id = 0
        self._began = 0.0
        self._last_beat = 0.0
        self._last_look = 0.0
        self._unseen_s = 0.0
        self._seen: traceback.StackSummary | None = None
        self._gc_started = 0.0
        self._gc_s = 0.0

    async def __aenter__(self) -> Self:
        self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    def start(self) -> None:
        """Watch the running loop from now on."""
        self._thread_id = threading.get_ident()
        self._began = self._last_beat = self._last_look = time.perf_counter()
        gc.callbacks.append(self._on_gc)
        self._watcher = threading.Thread(target=self._watch, name="loop-watcher", daemon=True)
        self._watcher.start()
        self._task = asyncio.create_task(self._beat(), name="loop monitor")

    async def stop(self) -> None:
        """Watch no more; nothing where it never began."""
        if self._task is None or self._watcher is None:
            return
        self._stop.set()
        gc.callbacks.remove(self._on_gc)
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        await asyncio.to_thread(self._watcher.join)

    async def _beat(self) -> None:
        waits, cpu, all_cpu = _waits(), time.thread_time(), time.process_time()
        while True:
            self._gc_s = 0.0
            self._last_beat = started = time.perf_counter()
            await asyncio.sleep(self._interval_s)
            gap = time.perf_counter() - started - self._interval_s
            self.beats += 1
            if gap > self.threshold_s and not self._was_stopped(gap, all_cpu):
                self._record(gap, waits, cpu)
            if gap > self.threshold_s or self.beats % 8 == 0:
                waits = _waits()
            cpu, all_cpu = time.thread_time(), time.process_time()
            self._seen, self._unseen_s = None, 0.0

    def _was_stopped(self, gap: float, all_cpu: float) -> bool:
        """Whether the whole process stood still: signals, or a machine that was put to sleep."""
        unseen_s = max(self._unseen_s, time.perf_counter() - self._last_look)
        return unseen_s > 0.9 * gap and time.process_time() - all_cpu < 0.05 * gap

    def _record(self, gap: float, waits: dict[str, float], cpu: float) -> None:
        now = _waits()
        passed = {thread: now[thread] - waits.get(thread, 0.0) for thread in now}
        waited = passed.pop("stolen") + max(passed.values(), default=0.0)
        seconds = max(0.0, gap - waited)
        self.longest_s = max(self.longest_s, seconds)
        if seconds <= self.threshold_s:
            return
        used = time.thread_time() - cpu
        at_s = time.perf_counter() - self._began
        stack = "".join(self._seen.format()) if self._seen else ""
        stall = Stall(at_s, seconds, gap, waited, used, self._gc_s, stack)
        self.count += 1
        self.stalls = sorted([*self.stalls, stall], key=lambda s: -s.seconds)[:100]
        logger.warning("the event loop stood still for %.0f ms\n%s", seconds * 1e3, stall.stack)

    def _watch(self) -> None:
        """Look at the loop's thread whenever its heartbeat is late."""
        while not self._stop.wait(self.threshold_s / 4):
            now = time.perf_counter()
            self._unseen_s = max(self._unseen_s, now - self._last_look)
            self._last_look = now
            late = now - self._last_beat - self._interval_s
            if late > self.threshold_s / 2 and not self._seen:
                frame: FrameType | None = sys._current_frames().get(self._thread_id)
                self._seen = _stack_of(frame) if frame else None

    def _on_gc(self, phase: str, _info: dict[str, int]) -> None:
        if phase == "start":
            self._gc_started = time.perf_counter()
        elif threading.get_ident() == self._thread_id:
            self._gc_s += time.perf_counter() - self._gc_started


def _stack_of(frame: FrameType) -> traceback.StackSummary:
    """The innermost frames; their lines are read from the files when they are wanted."""
    frames = traceback.walk_stack(frame)
    found = traceback.StackSummary.extract(frames, limit=12, lookup_lines=False)
    found.reverse()
    return found


def _waits() -> dict[str, float]:
    """Seconds that each thread of this process was ready to run but did not, by thread id."""
    waits = {"stolen": _stolen()}
    with contextlib.suppress(OSError):  # no Linux
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError, ValueError, IndexError):
                line = _first_bytes(f"/proc/self/task/{thread}/schedstat")
                waits[thread] = int(line.split()[1]) * 1e-9
    return waits


def _stolen() -> float:
    """Seconds that a hypervisor kept processors from this machine since it started."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        ticks = int(_first_bytes("/proc/stat").split(b"\n", 1)[0].split()[8])
        return ticks / os.sysconf("SC_CLK_TCK")
    return 0.0


def _first_bytes(path: str) -> bytes:
    """The beginning of a small file, in as few calls as can be: each may cost the loop its turn."""
    file = os.open(path, os.O_RDONLY)
    try:
        return os.read(file, 512)
    finally:
        os.close(file)
