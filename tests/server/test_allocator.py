"""Memory that a server is done with goes back to the system."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest

from magic_server import allocator

REPOSITORY = Path(__file__).resolve().parents[2]
FILL_AND_FREE = """
import threading
import numpy as np
import psutil
from magic_server import allocator

rss = lambda: psutil.Process().memory_info().rss
allocator.keep_few_pools()
kept = []

def fill():
    blocks = [np.ones(1000) for _ in range(2000)]  # 16 MB in blocks that share pages
    kept.append(blocks[-1])  # the end of a pool is in use: it cannot shrink by itself

before = rss()
threads = [threading.Thread(target=fill) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
freed = rss()
allocator.trim()
print(before, freed, rss())
"""


def test_what_threads_have_freed_goes_back() -> None:
    if allocator._library() is None:
        pytest.skip("another C library than glibc")
    done = subprocess.run(
        [sys.executable, "-c", FILL_AND_FREE],
        cwd=REPOSITORY, capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    before, _, trimmed = map(int, done.stdout.split())
    assert trimmed - before < 8_000_000


async def test_pages_are_given_back_again_and_again_until_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    often, twice = [], asyncio.Event()
    loop = asyncio.get_running_loop()

    def trim() -> None:
        often.append(None)
        if len(often) >= 2:
            loop.call_soon_threadsafe(twice.set)

    monkeypatch.setattr(allocator, "trim", trim)
    async with allocator.trimmed(every_s=0.001), asyncio.timeout(60):
        await twice.wait()
    count = len(often)
    await asyncio.sleep(0.05)
    assert len(often) <= count + 1  # one may have been on its way


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(allocator, "_library", lambda: None)
    allocator.keep_few_pools()
    allocator.trim()
