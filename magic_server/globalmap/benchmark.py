"""Merging measured: against the paper's scheme at equal PSNR, and the memory it takes.

The paper refines the appended map by 3,000 steps on keyframes drawn at random, with the rates of
the mapping stage. Both schemes run on the same kernels, threads and sub-maps, one after the other.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magic_core.geometry import se3
from magic_core.render import GaussianOptimiser, LossWeights
from magic_core.render.backend import Optimiser
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.placement import PlacedSource, Pose, View, coarse_merge, views_of
from magic_server.globalmap.quality import mean_psnr
from magic_server.globalmap.refine import FineStage

Said = Callable[[str], None]
_APART_M = 100.0  # between a map and its copy


@dataclass(slots=True)
class _Clock:
    """Wall and processor time of a scheme, without that of judging it."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    _since: tuple[float, float] = (0.0, 0.0)

    def go(self) -> None:
        self._since = (time.perf_counter(), time.process_time())

    def stop(self) -> None:
        self.wall_s += time.perf_counter() - self._since[0]
        self.cpu_s += time.process_time() - self._since[1]


@dataclass(frozen=True, slots=True)
class Judge:
    """Views on which a map is judged."""

    train: Sequence[View]
    """Keyframes, which both schemes learn from."""
    novel: Sequence[View]
    """Frames that neither learns from; may be empty."""

    def __call__(self, optimiser: Optimiser) -> dict[str, float]:
        """Mean PSNR in dB of each kind."""
        return {
            "train_db": mean_psnr(optimiser, self.train),
            "novel_db": mean_psnr(optimiser, self.novel),
        }


def paper_scheme(
    sources: Sequence[PlacedSource],
    judge: Judge,
    config: MergeConfig,
    *,
    iterations: int,
    said: Said,
) -> dict[str, Any]:
    """The paper's refinement: keyframes at random, constant rates, pruning by opacity."""
    clock = _Clock()
    clock.go()
    coarse, views = coarse_merge(sources), views_of(sources)
    clock.stop()
    optimiser = GaussianOptimiser(
        coarse,
        weights=LossWeights(
            ssim=config.ssim_weight, depth=config.depth_weight, scale=config.regularisation_weight
        ),
        threads=config.threads or None,
    )
    before = judge(optimiser)
    rng = np.random.default_rng(config.seed)
    clock.go()
    for step in range(1, iterations + 1):
        view = views[rng.integers(len(views))]
        optimiser.step(view.camera, view.world_from_camera, view.colour, view.depth)
        if step % 100 == 0:
            optimiser.prune(optimiser.gaussians().opacities >= config.prune_opacity)
            said(f"the paper's scheme: step {step} of {iterations}")
    clock.stop()
    return {
        "iterations": iterations,
        "wall_s": clock.wall_s,
        "cpu_s": clock.cpu_s,
        "gaussians": len(optimiser),
        "coarse": before,
        **judge(optimiser),
    }


def our_scheme(
    sources: Sequence[PlacedSource],
    judge: Judge,
    config: MergeConfig,
    *,
    goal_db: float,
    said: Said,
) -> dict[str, Any]:
    """Our refinement, judged after each pass; says when it first reached a train PSNR."""
    from magic_server.globalmap.rounds import optimiser_of

    clock = _Clock()
    clock.go()
    optimiser, views = optimiser_of(coarse_merge(sources), config), views_of(sources)
    curve: list[dict[str, Any]] = []

    def after_pass(done: int) -> bool:
        clock.stop()
        point = {"iterations": done, "wall_s": clock.wall_s, "cpu_s": clock.cpu_s}
        curve.append({**point, "gaussians": len(optimiser), **judge(optimiser)})
        said(f"our scheme: step {done}, {curve[-1]['train_db']:.2f} dB of {goal_db:.2f}")
        clock.go()
        return False

    result = FineStage(
        optimiser, views, config, progress=lambda *_: None, after_pass=after_pass
    ).run()
    clock.stop()
    reached = next((point for point in curve if point["train_db"] >= goal_db), None)
    return {
        "converged": result.converged,
        "curve": curve,
        "reached": reached,
        **curve[-1],
    }


@dataclass(frozen=True, slots=True)
class MovedSource:
    """A sub-map put somewhere else."""

    source: PlacedSource
    moved_from_world: Pose

    @property
    def world_from_anchor(self) -> Pose:
        """(4, 4)."""
        return self.moved_from_world @ self.source.world_from_anchor

    @property
    def camera(self):
        """The camera of all its keyframes."""
        return self.source.camera

    def gaussians(self):
        """The Gaussians, in the anchor frame."""
        return self.source.gaussians()

    def keyframe_poses(self) -> list[Pose]:
        """anchor_from_camera (4, 4) of every keyframe."""
        return self.source.keyframe_poses()

    def images(self, keyframe: int):
        """Colour and depth of one keyframe."""
        return self.source.images(keyframe)


def memory(
    sources: Sequence[PlacedSource], config: MergeConfig, *, passes: int, said: Said
) -> dict[str, Any]:
    """Peak memory of merging a map, and of merging it beside a copy of itself, in new processes.

    Each is a whole merge with few passes: reading, refining, writing.
    """
    few = dataclasses.replace(config, passes=passes, converged=0.0)
    aside = se3.from_rotation_translation(np.eye(3), [_APART_M, 0.0, 0.0])
    twice = [*sources, *(MovedSource(source, aside) for source in sources)]
    peaks = []
    for number, chosen in enumerate((list(sources), twice)):
        said(f"memory: {len(chosen)} sub-maps")
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            peaks.append(pool.submit(_peak_of, chosen, few).result() | {"doubled": bool(number)})
    return {"runs": peaks, "ratio": peaks[1]["peak_bytes"] / peaks[0]["peak_bytes"]}


def _peak_of(sources: Sequence[PlacedSource], config: MergeConfig) -> dict[str, Any]:
    """Merge into files and read this process's high-water mark."""
    from magic_core.gaussians import stream
    from magic_server.globalmap.merge import merge_into

    with tempfile.TemporaryDirectory(prefix="magic-memory-") as name:
        folder = Path(name)
        parts, summary = merge_into(folder, sources, config, progress=lambda *_: None)

        def pieces():
            return parts.clouds(summary.blocks)

        stream.write_ply_pieces(folder / "map.ply", pieces)
        stream.write_compact_pieces(folder / "map.compact", pieces)
    status = Path("/proc/self/status").read_text()
    peak = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
    return {
        "submaps": len(sources),
        "blocks": summary.blocks,
        "gaussians": summary.gaussians,
        "peak_bytes": 1024 * int(peak),
    }
