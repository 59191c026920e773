"""How the index of descriptors and the pose graph grow from a thousand sub-maps to a million.

A hundred simulated agents; everything else is the server's own: the FAISS index (exact, then an
inverted file) and the pose graph that takes in sub-maps and accepted loops (by neighbourhood, then
by regions). Each size runs in a process of its own, so that its memory can be told. Times are of
the processor, one thread; a size that runs into a limit is recorded with that limit.

Examples:
  OMP_NUM_THREADS=1 python benchmarks/cluster/scale.py descriptors --sizes 1000 10000 100000 1000000
  OMP_NUM_THREADS=1 python benchmarks/cluster/scale.py graph --sizes 1000 10000 --out graph.jsonl
  OMP_NUM_THREADS=1 python benchmarks/cluster/recorded.py runs/room > server.jsonl
  python benchmarks/cluster/scale.py plot descriptors.jsonl graph.jsonl server.jsonl --out scale.png
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from magic_server.posegraph import Edge, PoseGraphConfig, stacked
from magic_server.posegraph.simulated import INFORMATION, SIGMAS

if TYPE_CHECKING:
    from magic_server.posegraph.online import NewVertex

AGENTS = 100
Array = NDArray[np.float64]
DENSITY_PER_M2 = 1.4
LOOP_REACH_M = 3.0
SAME_PLACE_NOISE = 0.5
"""Length of what two descriptors of one place differ by; the unit vectors of places are random."""
WANTED = 64
"""How many neighbours a new sub-map asks for."""


def rss_mib() -> float:
    """The most memory that this process has had."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def spread(seconds: list[float]) -> dict:
    """p50, p99 and the largest in milliseconds."""
    found = np.percentile(1e3 * np.array(seconds), (50, 99, 100)).round(3).tolist()
    return dict(zip(("p50", "p99", "max"), found, strict=True))


def measure_descriptors(size: int, *, dimension: int, queries: int) -> dict:
    """Fill the index with one descriptor per sub-map, ten of each place; then ask it."""
    from magic_server.places import DescriptorIndex, Place

    generator = np.random.default_rng(0)
    places = generator.normal(size=(max(size // 10, 1), dimension)).astype(np.float32)
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    empty = rss_mib()

    def seen(numbers: NDArray) -> NDArray[np.float32]:
        noise = generator.normal(size=(len(numbers), dimension)).astype(np.float32)
        return places[numbers % len(places)] + noise * SAME_PLACE_NOISE / dimension**0.5

    index = DescriptorIndex(dimension)
    load_s, chunk = 0.0, 10_000
    for first in range(0, size, chunk):
        numbers = np.arange(first, min(first + chunk, size))
        vectors = list(seen(numbers))
        started = time.process_time()
        submaps = [f"sessions/s/agents/a{n % AGENTS}/submaps/{n}" for n in numbers]
        index.load([Place(*one) for one in zip(submaps, vectors, strict=True)])
        load_s += time.process_time() - started
    asked = generator.integers(0, len(places), queries)
    times, found, possible = [], 0, 0
    for number, vector in zip(asked.tolist(), seen(asked), strict=True):
        started = time.process_time()
        hits = index.query(vector, WANTED)
        times.append(time.process_time() - started)
        right = set(range(number, size, len(places)))
        found += len(right & {int(hit.name.rpartition("/")[2]) for hit in hits})
        possible += len(right)
    adds = []
    for extra, vector in enumerate(seen(generator.integers(0, len(places), 200))):
        started = time.process_time()
        index.add(Place(f"extra/{extra}", vector))
        adds.append(time.process_time() - started)
    return {
        "part": "descriptors",
        "size": size,
        "dimension": dimension,
        "exact": index.is_exact,
        "load_s": round(load_s, 2),
        "query_ms": spread(times),
        "add_ms": spread(adds),
        "of_one_place_found": round(found / possible, 4),
        "mib": round(rss_mib() - empty, 1),
    }


def hall(size: int, generator: np.random.Generator) -> Array:
    """(size, 4, 4) in order of arrival, the agents in turns: each wanders through one hall."""
    side_m = (size / DENSITY_PER_M2) ** 0.5
    steps = -(-size // AGENTS)
    heading = generator.uniform(0, 7, AGENTS) + np.cumsum(
        generator.normal(size=(steps, AGENTS)) * 0.15, axis=0
    )
    ahead = 0.7 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    at = generator.uniform(0, side_m, (AGENTS, 2)) + np.cumsum(ahead, axis=0)
    at = side_m - np.abs(at % (2 * side_m) - side_m)  # walls throw them back
    vectors = np.zeros((steps, AGENTS, 6))
    vectors[..., 5] = heading
    poses = stacked.exp(vectors)
    poses[..., :2, 3] = at
    return poses.reshape(-1, 4, 4)[:size]


def partners(poses: Array, generator: np.random.Generator) -> NDArray[np.int64]:
    """(size,) an older sub-map near each one, -1 where there is none."""
    tree = KDTree(poses[:, :2, 3])
    found = np.full(len(poses), -1, dtype=np.int64)
    distance, near = tree.query(
        poses[:, :2, 3], k=min(33, len(poses)), distance_upper_bound=LOOP_REACH_M
    )
    for column in generator.permutation(np.arange(1, near.shape[1])):
        other = near[:, column]
        fits = np.isfinite(distance[:, column]) & (other < np.arange(len(poses)) - 20 * AGENTS)
        other_agent = other < np.arange(len(poses))
        other_agent &= other % AGENTS != np.arange(len(poses)) % AGENTS
        found = np.where((found < 0) & np.isfinite(distance[:, column]) & (fits | other_agent),
                         other, found)  # fmt: skip
    return found


@dataclass(frozen=True, slots=True)
class Simulated:
    """Sub-maps of agents that wander through one hall, as they would be submitted."""

    truth: Array  # (n, 4, 4) world_from_anchor
    names: list[str]
    """Resource names, in order of arrival."""
    tracked: Array  # (n - AGENTS, 4, 4) from each agent's sub-map before, as measured
    loops: dict[int, Edge]
    """By the number of the newer sub-map."""

    @classmethod
    def of(cls, count: int) -> Simulated:
        """The same ones every time."""
        generator = np.random.default_rng(0)
        truth = hall(count, generator)
        partner = partners(truth, generator)

        def measured(source: NDArray, target: NDArray) -> Array:
            noise = stacked.exp(generator.normal(size=(len(source), 6)) * SIGMAS)
            return stacked.inverse(truth[source]) @ truth[target] @ noise

        names = [f"sessions/s/agents/a{n % AGENTS}/submaps/{n // AGENTS}" for n in range(count)]
        later = np.arange(AGENTS, count)
        tracked = measured(later - AGENTS, later)
        looped = np.flatnonzero(partner >= 0)
        matched = measured(partner[looped], looped)
        loops = {
            n: Edge(names[partner[n]], names[n], matched[row], INFORMATION)
            for row, n in enumerate(looped.tolist())
        }
        return cls(truth, names, tracked, loops)

    def vertex(self, n: int) -> NewVertex:
        """A sub-map with its odometry edge."""
        from magic_server.posegraph.online import NewVertex

        edge = None
        if n >= AGENTS:
            before = self.names[n - AGENTS]
            edge = Edge(before, self.names[n], self.tracked[n - AGENTS], INFORMATION)
        return NewVertex(self.names[n], edge, group=f"a{n % AGENTS}")


def measure_graph(size: int, *, added: int, hierarchy: str) -> dict:
    """A graph of `size` sub-maps as after a restart; then `added` arrive, each with a loop.

    A large one is condensed and settled exactly before that, which a server does elsewhere.
    """
    from magic_server.posegraph.online import OnlineGraph
    from magic_server.posegraph.settlement import settled

    simulated = Simulated.of(size + added)
    names, edges, vertex = simulated.names, simulated.loops, simulated.vertex
    old = [n for n in edges if n < size]
    simulated_mib = rss_mib()
    config = PoseGraphConfig(
        odometry_floor_m=0.0, odometry_floor_rad=0.0, odometry_floor_share=0.0,
        hierarchy=hierarchy,  # type: ignore[arg-type]
    )  # fmt: skip
    graph = OnlineGraph(config)
    started = time.process_time()
    graph.restore(
        [vertex(n) for n in range(size)], [edges[n] for n in old],
        poses={names[n]: (names[0], simulated.truth[n]) for n in range(size)},
        kept=range(len(old)), settled=True,
    )  # fmt: skip
    restore_s = time.process_time() - started
    started = time.process_time()
    regions = graph.outline().condensed() if graph.is_uncondensed else None
    condense_s = time.process_time() - started
    optimum = settled(graph.counted()) if graph.is_large else None
    settle_s = time.process_time() - started - condense_s
    graph.advance([], [], optimum, regions)
    begin_s = time.process_time() - started - condense_s - settle_s
    del regions, optimum
    placed, accepted, told = [], [], []
    for n in range(size, size + added):
        started = time.process_time()
        graph.advance([vertex(n)], [])
        placed.append(time.process_time() - started)
        if n not in edges:
            continue
        started = time.process_time()
        change = graph.advance([], [edges[n]])
        if len(change.taken_up):
            accepted.append(time.process_time() - started)
            told.append(len(change.vertices))
    return {
        "part": "graph",
        "size": size,
        "hierarchy": hierarchy,
        "restore_s": round(restore_s, 2),
        "condense_s": round(condense_s, 2),
        "settle_s": round(settle_s, 2),
        "begin_s": round(begin_s, 2),
        "placed_ms": spread(placed),
        "accepted_loop_ms": spread(accepted),
        "loops_taken_up": len(accepted),
        "told_p50": float(np.median(told)),
        "mib": round(rss_mib() - simulated_mib, 1),
    }


def each_alone(options: argparse.Namespace) -> None:
    """One process per size; what a limit stops is recorded as such."""
    for size in options.sizes:
        command = [sys.executable, __file__, options.part, "--one", str(size),
                   "--dimension", str(options.dimension), "--added", str(options.added),
                   "--hierarchy", options.hierarchy]  # fmt: skip
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, timeout=options.limit_s
            )
            said = done.stderr.strip().splitlines()
            failed = f"ended with {done.returncode}: {said[-1] if said else 'no message'}"
        except subprocess.TimeoutExpired:
            done, failed = None, f"not done after {options.limit_s} s"
        ok = done is not None and done.returncode == 0
        line = done.stdout.strip() if ok and done is not None else json.dumps(
            {"part": options.part, "size": size, "limit": failed}
        )  # fmt: skip
        print(line, flush=True)
        if options.out is not None:
            with options.out.open("a") as file:
                file.write(line + "\n")


def plot(files: list[Path], out: Path) -> None:
    """Growth of times and memory over the number of sub-maps, all axes logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    rows = [row for row in rows if "part" in row and "limit" not in row]
    figure, (times, starts, memory) = pyplot.subplots(1, 3, figsize=(14, 5.2))
    for part, kind in sorted({(row["part"], _kind(row)) for row in rows}):
        own = [row for row in rows if (row["part"], _kind(row)) == (part, kind)]
        own.sort(key=lambda row: row["size"])
        sizes = [row["size"] for row in own]
        for key in _TIMES[part]:
            label = f"{key.removesuffix('_ms').replace('_', ' ')}, {kind}"
            (line,) = times.loglog(sizes, [row[key]["p50"] for row in own], "o-", label=label)
            p99 = [row[key]["p99"] for row in own]
            times.loglog(sizes, p99, "_", color=line.get_color(), markersize=12)
        begun = [row[_START[part]] for row in own]
        label = kind if part == "server" else f"{part}, {kind}"
        starts.loglog(sizes, begun, "o-", label=label)
        memory.loglog(sizes, [row["mib"] for row in own], "o-", label=label)
    times.set(xlabel="sub-maps", ylabel="ms, p50 (dots) and p99 (bars)")
    starts.set(xlabel="sub-maps", ylabel="s of processor until it is taken up")
    memory.set(xlabel="sub-maps", ylabel="MiB at most")
    for axes in (times, starts, memory):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    figure.tight_layout()
    figure.savefig(out, dpi=90)


_TIMES = {
    "descriptors": ("query_ms",),
    "graph": ("placed_ms", "accepted_loop_ms"),
    "server": ("query_ms", "transaction_ms", "header_ms"),
}
_START = {"descriptors": "load_s", "graph": "restore_s", "server": "start_s"}


def _kind(row: dict) -> str:
    if row["part"] == "descriptors":
        return f"{row['dimension']} numbers"
    if row["part"] == "server":
        return f"whole server, {row['dimension']} numbers"
    return f"hierarchy {row['hierarchy']}"


def main() -> None:
    """Measure, or draw what was measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("descriptors", "graph", "plot"))
    parser.add_argument("files", type=Path, nargs="*", help="results to draw")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--dimension", type=int, default=384)
    parser.add_argument("--queries", type=int, default=300)
    parser.add_argument("--added", type=int, default=200)
    parser.add_argument("--hierarchy", choices=("auto", "on", "off"), default="auto")
    parser.add_argument("--limit-s", type=float, default=3600.0, help="of one size")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part == "plot":
        plot(options.files, options.out or Path("scale.png"))
    elif options.one is None:
        each_alone(options)
    elif options.part == "descriptors":
        result = measure_descriptors(
            options.one, dimension=options.dimension, queries=options.queries
        )
        print(json.dumps(result))
    else:
        result = measure_graph(options.one, added=options.added, hierarchy=options.hierarchy)
        print(json.dumps(result))


if __name__ == "__main__":
    main()
