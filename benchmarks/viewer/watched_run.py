"""What watching costs a run: the same `magic run` with and without a viewer that somebody looks at.

Runs in turns, so that whatever else the machine does meets both. With the viewer one visitor reads
the page over its websocket, as a browser does. Processor times are those of the processes.

Example: python benchmarks/viewer/watched_run.py DATASET --frames 60 --scale 0.5 --repeats 2
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

from magic_cli.benchmarks.viewer import Visitor

_PAGE = re.compile(r"Open (http://\S+) in a browser")
_LOOK_S = 0.25
_PARTS = ("serve", "view", "agent")


def main() -> None:
    """Print one line per run and one JSON object of the medians as the last line."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("dataset")
    options.add_argument("--frames", type=int, default=60)
    options.add_argument("--scale", type=float, default=0.5)
    options.add_argument("--repeats", type=int, default=2)
    chosen = options.parse_args()
    found: dict[str, list[dict[str, float]]] = {"unwatched": [], "watched": []}
    for number in range(2 * chosen.repeats):
        kind = ("unwatched", "watched")[number % 2]
        figures = _run(chosen, watched=kind == "watched")
        found[kind].append(figures)
        print(kind, json.dumps(figures), flush=True)
    medians = {
        kind: {name: statistics.median(run[name] for run in runs) for name in runs[0]}
        for kind, runs in found.items()
    }
    print(json.dumps(medians))


def _run(chosen: argparse.Namespace, *, watched: bool) -> dict[str, float]:
    """Times of one run, seconds, and bytes that the visitor got."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable, "-P", "-m", "magic_cli", "run", chosen.dataset, "--out", f"{folder}/o",
            "--frames", str(chosen.frames), "--scale", str(chosen.scale), "--no-report", "--json",
            "--merge.passes", "1", *(["--viewer", "--viewer-port", "0"] if watched else []),
        ]  # fmt: skip
        log, printed = Path(folder) / "log.txt", Path(folder) / "printed.txt"
        with log.open("w") as messages, printed.open("w") as output:
            process = subprocess.Popen(command, stdout=output, stderr=messages)
        visitor, reading = Visitor(), False
        spent: dict[tuple[str, int], float] = {}
        for times in _looks(process):
            spent.update(times)
            page = _PAGE.search(log.read_text()) if watched and not reading else None
            if page:
                address = page[1].replace("http://", "ws://")
                threading.Thread(target=visitor.read, args=(address,), daemon=True).start()
                reading = True
        assert process.returncode == 0, log.read_text()
        metrics = json.loads(printed.read_text().strip().splitlines()[-1])
        return _figures(metrics, spent, visitor)


def _looks(process: subprocess.Popen) -> Iterator[dict[tuple[str, int], float]]:
    """The processor time so far of each part's processes, until the run ends."""
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):
            yield dict(_parts(psutil.Process(process.pid)))
        time.sleep(_LOOK_S)


def _parts(run: psutil.Process) -> Iterator[tuple[tuple[str, int], float]]:
    """(part, process) and the processor time, of the run's children and their own children."""
    for child in run.children():
        with contextlib.suppress(psutil.Error):
            name = next((word for word in child.cmdline() if word in _PARTS), "other")
            for one in (child, *child.children(recursive=True)):
                part = name if one is child else f"{name} jobs"
                times = one.cpu_times()
                yield (part, one.pid), times.user + times.system


def _figures(metrics: dict, spent: dict, visitor: Visitor) -> dict[str, float]:
    figures = {
        "frames_per_s": metrics["fps"],
        "tracking_ms": metrics["tracking_ms"]["median"],
        "visitor_mb": visitor.received / 1e6,
    }
    for part in ("serve", "serve jobs", "agent", "view"):
        figures[f"{part}_cpu_s"] = sum(s for (name, _), s in spent.items() if name == part)
    return {name: round(float(value), 4) for name, value in figures.items()}


if __name__ == "__main__":
    main()
