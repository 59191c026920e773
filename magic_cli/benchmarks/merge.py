"""`magic bench merge RUN|DATASET`: merging against the paper's scheme, and its memory.

Refines the appended map of a run twice: by the paper's 3,000 steps on keyframes at random, and by
ours, and says when ours first showed keyframes as well as the paper's did at its end. Then merges
the run, and the run beside a copy of itself, in fresh processes, and compares their peak memory.
"""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from magic_cli.benchmarks.stored import is_run_folder, stored_sources
from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.evaluation import RunFolder
from magic_server.globalmap import MergeConfig


@dataclass(frozen=True, slots=True)
class MergeBenchmark:
    """Options of `magic bench merge`."""

    what: Positional[Path]
    """A run folder, or a dataset, which is mapped first."""
    scale: float = 0.5
    """Image scale at which a dataset is mapped."""
    iterations: int = 3000
    """Steps of the paper's scheme."""
    views: int = 24
    """Views of each kind on which maps are judged."""
    speed: bool = True
    """Compare the two schemes."""
    memory: bool = True
    """Measure the peak memory."""
    memory_passes: int = 2
    """Passes of the merges whose memory is measured."""
    memory_block_views: int = 48
    """Most keyframes of a block in them."""
    merge: MergeConfig = field(default_factory=MergeConfig)
    """Our scheme; its threads and losses hold for both."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its tables."""
    config = parse(MergeBenchmark, arguments, prog="magic bench merge", description=__doc__ or "")
    config.merge.validate()
    with tempfile.TemporaryDirectory(prefix="magic-bench-") as scratch:
        folder = RunFolder(config.what)
        if not is_run_folder(config.what):
            folder = _mapped(config, Path(scratch) / "run")
        result = _measured(folder, config)
    for rows in _tables(result):
        console.print(rows)
    if config.json:
        print_json(result)
    return 0


def _mapped(config: MergeBenchmark, out: Path) -> RunFolder:
    from magic_cli.run import RunConfig, run

    coarse = dataclasses.replace(config.merge, refine=False)
    run(RunConfig(dataset=str(config.what), out=out, scale=config.scale, report=False,
                  merge=coarse))  # fmt: skip
    return RunFolder(out)


def _measured(folder: RunFolder, config: MergeBenchmark) -> dict[str, Any]:
    from magic_server.globalmap import benchmark

    sources = stored_sources(folder)
    result: dict[str, Any] = {"submaps": len(sources)}
    with console.status("merging") as status:
        if config.speed:
            judge = judge_of(folder, config.views, sources)
            paper = benchmark.paper_scheme(
                sources, judge, config.merge, iterations=config.iterations, said=status.update
            )
            ours = benchmark.our_scheme(
                sources, judge, config.merge, goal_db=paper["train_db"], said=status.update
            )
            reached = ours["reached"]
            result |= {"paper": paper, "ours": ours, "speedup": None if reached is None else {
                clock: paper[clock] / reached[clock] for clock in ("wall_s", "cpu_s")
            }}  # fmt: skip
        if config.memory:
            bounded = dataclasses.replace(config.merge, block_views=config.memory_block_views)
            result["memory"] = benchmark.memory(
                sources, bounded, passes=config.memory_passes, said=status.update
            )
    return result


def judge_of(folder: RunFolder, count: int, sources: Any) -> Any:
    """Real frames of the run's data, and keyframes as they are stored."""
    import numpy as np

    from magic_cli.run import RunConfig
    from magic_core.config import load_yaml
    from magic_core.data import open_dataset
    from magic_core.evaluation.views import choose_views
    from magic_server.globalmap.benchmark import Judge
    from magic_server.globalmap.placement import View, view_of

    run = load_yaml(RunConfig, folder.config_path)
    data = open_dataset(run.dataset, scale=run.scale, max_frames=run.frames, stride=run.stride)
    novel = [
        View(view.source.camera, view.world_from_camera, frame.colour, frame.depth)
        for view in choose_views(folder, data, per_kind=count)
        if view.kind == "novel" and (frame := view.source[view.index]) is not None
    ]
    every = [(s, k) for s in sources for k in range(len(s.keyframe_poses()))]
    chosen = np.unique(np.linspace(0, len(every) - 1, min(count, len(every))).round().astype(int))
    return Judge([view_of(*every[i]) for i in chosen], novel)


def _tables(result: dict[str, Any]):
    if "paper" in result:
        paper, ours, reached = result["paper"], result["ours"], result["ours"]["reached"]
        rows = [["the paper's scheme", *_row(paper)]]
        if reached is not None:
            rows.append(["ours, as good on keyframes", *_row(reached)])
        rows.append(["ours, at its end", *_row(ours)])
        columns = ["", "steps", "time", "processor", "keyframes", "new views", "Gaussians"]
        speedup = result["speedup"]
        title = "not reached" if speedup is None else f"{speedup['cpu_s']:.1f} times faster"
        yield table(f"Fine merging of {result['submaps']} sub-maps: {title}", columns, rows)
    if "memory" in result:
        rows = [
            [str(run["submaps"]), str(run["blocks"]), f"{run['gaussians']:,}",
             f"{run['peak_bytes'] / 1e6:.0f} MB"]
            for run in result["memory"]["runs"]
        ]  # fmt: skip
        title = f"Peak memory of a merge: {result['memory']['ratio']:.2f} times for twice the map"
        yield table(title, ["sub-maps", "blocks", "Gaussians", "peak"], rows)


def _row(point: dict[str, Any]) -> list[str]:
    return [str(point["iterations"]), f"{point['wall_s']:.0f} s", f"{point['cpu_s']:.0f} s",
            f"{point['train_db']:.2f} dB", f"{point['novel_db']:.2f} dB",
            f"{point['gaussians']:,}"]  # fmt: skip
