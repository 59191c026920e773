"""Feeds a server's checks and a live server with damaged messages, and looks for what gets through.

    python -m tests.faults.fuzz --messages 100000 --seed 1 --json

Nineteen of twenty messages go through the functions that the server uses, without the network:
headers, blobs, images, chunks, archives. The rest go to a live server over gRPC: RPCs, uploads
and imports. A message may be accepted, where a change left it right, or refused with a code
that blames the caller. Everything runs in a child process, so that a crash is seen and counted; the
message that caused it is made again from the seed and its number.

Exits with 1 on a crash, a hang, a leak, another code, or a file that only a refused message left.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil

from magic_core.errors import MagicError
from tests.faults.fuzz_checks import CHECKS, Material

LIVE_SHARE = 0.05
HANG_S = 20.0
LEAK_BYTES = 64 << 20
WARM_UP_SHARE = 0.3
ALLOWED = frozenset(
    ("INVALID_ARGUMENT", "DATA_LOSS", "RESOURCE_EXHAUSTED", "NOT_FOUND", "FAILED_PRECONDITION",
     "ALREADY_EXISTS")
)  # fmt: skip


class Hang(Exception):
    """A check took longer than any should."""


def check_all(messages: int, seed: int, start: int) -> dict:
    """Run the checks on messages `start` to `messages`; prints each number it begins."""
    codes: Counter[str] = Counter()
    wrong: list[dict] = []
    hangs = 0
    rss_warm, process = 0, psutil.Process()
    material, kinds = Material.make(), list(CHECKS)
    signal.signal(signal.SIGALRM, _raise_hang)
    for number in range(start, messages):
        if number % 50 == 0:
            print(json.dumps({"at": number}), flush=True)
        kind = kinds[number % len(kinds)]
        signal.setitimer(signal.ITIMER_REAL, HANG_S)
        try:
            CHECKS[kind](material, random.Random(f"{seed}/{kind}/{number}"))
            code = "OK"
        except MagicError as error:
            code = error.grpc_code
        except Hang:
            code, hangs = "HANG", hangs + 1
        except Exception as error:
            code = "INTERNAL"
            wrong.append({"kind": kind, "number": number, "error": repr(error)[:300]})
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        codes[f"{kind} {code}"] += 1
        if code not in ALLOWED | {"OK", "INTERNAL", "HANG"}:
            wrong.append({"kind": kind, "number": number, "error": code})
        if number == start + int(WARM_UP_SHARE * (messages - start)):
            rss_warm = process.memory_info().rss
    growth = process.memory_info().rss - rss_warm
    return {"codes": codes, "wrong": wrong, "hangs": hangs, "rss_growth_bytes": growth}


def _raise_hang(*_: object) -> None:
    raise Hang


def supervised(arguments: list[str], *, stalled_s: float) -> tuple[dict | None, int, str]:
    """A child's result, the last number it began, and how it died if it did."""
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.faults.fuzz", *arguments],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    at, result, watchdog = 0, None, _Watchdog(child, stalled_s)
    for line in child.stdout:
        watchdog.alive()
        said = json.loads(line)
        at = said.get("at", at)
        result = said.get("result", result)
    watchdog.stop()
    died = "" if child.wait() == 0 else f"exit status {child.returncode}"
    return result, at, died


class _Watchdog:
    """Kills a child that says nothing for too long."""

    def __init__(self, child: subprocess.Popen[str], stalled_s: float) -> None:
        import threading

        self._child, self._stalled_s = child, stalled_s
        self._last = time.monotonic()
        self._done = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def alive(self) -> None:
        self._last = time.monotonic()

    def stop(self) -> None:
        self._done.set()

    def _watch(self) -> None:
        while not self._done.wait(1.0):
            if time.monotonic() - self._last > self._stalled_s:
                self._child.kill()


def fuzz(messages: int, seed: int) -> dict:
    """Everything, in children that may die."""
    started = time.monotonic()
    live = round(LIVE_SHARE * messages)
    codes: Counter[str] = Counter()
    found: dict = {"crashes": [], "wrong_codes": [], "hangs": 0, "rss_growth_bytes": 0}
    for part, end in (("checks", messages - live), ("live", live)):
        begin = 0
        while begin < end:
            arguments = ["--part", part, "--messages", str(end), "--seed", str(seed)]
            result, at, died = supervised(
                [*arguments, "--start", str(begin)], stalled_s=10 * HANG_S
            )
            if died:
                # A child says its number every 50 messages: what died is one of those.
                found["crashes"].append({"part": part, "from": at, "how": died})
                begin = at + 50
                continue
            assert result is not None
            codes.update(result["codes"])
            found["wrong_codes"] += result["wrong"]
            found["hangs"] += result["hangs"]
            found["rss_growth_bytes"] = max(found["rss_growth_bytes"], result["rss_growth_bytes"])
            found |= {key: result[key] for key in ("stray_files", "open_files") if key in result}
            begin = end
    accepted = sum(count for code, count in codes.items() if code.endswith(" OK"))
    return {
        "messages": sum(codes.values()),
        "live_messages": live,
        "accepted": accepted,
        "refused": sum(codes.values()) - accepted,
        "crashes": len(found["crashes"]),
        "hangs": found["hangs"],
        "wrong_codes": len(found["wrong_codes"]),
        "stray_files": found.get("stray_files", 0),
        "open_files_growth": found.get("open_files", 0),
        "rss_growth_bytes": found["rss_growth_bytes"],
        "seconds": time.monotonic() - started,
        "codes": dict(sorted(codes.items())),
        "examples": found["crashes"][:10] + found["wrong_codes"][:20],
    }


def good(result: dict) -> bool:
    """Whether nothing got through."""
    bad = ("crashes", "hangs", "wrong_codes", "stray_files")
    return not any(result[key] for key in bad) and result["rss_growth_bytes"] < LEAK_BYTES


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    parser.add_argument("--part", choices=("checks", "live"), help=argparse.SUPPRESS)
    parser.add_argument("--start", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part == "checks":
        result = check_all(options.messages, options.seed, options.start)
        print(json.dumps({"result": result}), flush=True)
        return 0
    if options.part == "live":
        from tests.faults.fuzz_live import call_all

        with tempfile.TemporaryDirectory(prefix="magic-fuzz-") as folder:
            result = asyncio.run(
                call_all(Path(folder), options.messages, options.seed, options.start)
            )
        print(json.dumps({"result": result}), flush=True)
        return 0
    result = fuzz(options.messages, options.seed)
    if not options.json:
        for key, value in result.items():
            print(f"{key}: {value}")
    else:
        print(json.dumps(result))
    return 0 if good(result) else 1


if __name__ == "__main__":
    sys.exit(main())
