"""Public pose graphs to their optimum, and wrong loops on a sphere and among ten agents."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from magic_server.posegraph import PoseGraphConfig, PoseGraphProblem
from magic_server.posegraph.g2o import problem_of, read_g2o
from magic_server.posegraph.simulated import agents_in_a_hall, with_wrong_loops
from magic_server.posegraph.solve import solve
from magic_server.posegraph.solve_files import solve_files

CONFIG = PoseGraphConfig(odometry_floor_m=0.0, odometry_floor_rad=0.0, odometry_floor_share=0.0)


def main() -> None:
    """Run both parts on the graphs of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("graphs", type=Path, help="folder with sphere2500.g2o and others")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.2, 0.4, 0.6])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for name in ("smallGrid3D", "sphere2500", "parking-garage"):
        for robust in ("none", "gnc"):
            report = solve_files([options.graphs / f"{name}.g2o"], robust=robust)
            print(f"{name} {robust}: {report['error_after']:.6g} in {report['seconds']:.2f} s")
    for kind in ("clean", "spoiled"):
        folder = options.graphs / f"argos_4robots_{kind}"
        report = solve_files(sorted(folder.glob("*.g2o")))
        rejected = len(report["loops_rejected"])
        print(f"argos {kind}: kept {report['loops_kept']}, rejected {rejected}, "
              f"components {report['components']}, {report['seconds']:.2f} s")  # fmt: skip
    sphere = problem_of(read_g2o([options.graphs / "sphere2500.g2o"]))
    reference = solve(sphere, CONFIG).world_from_anchor
    _spoil("sphere2500", sphere, reference, options.shares, options.seed)
    hall = agents_in_a_hall()
    _spoil("ten agents", hall.problem, hall.truth, options.shares, options.seed)


def _spoil(
    name: str, problem: PoseGraphProblem, truth: dict, shares: list[float], seed: int
) -> None:
    clean = solve(problem, CONFIG)
    print(f"{name}: clean ATE {_ate(clean.world_from_anchor, truth):.4f} m")
    for kind in ("random", "groups"):
        for share in shares:
            spoiled, wrong = with_wrong_loops(problem, share=share, kind=kind, seed=seed)
            wall, cpu = time.perf_counter(), time.process_time()
            solution = solve(spoiled, CONFIG)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            kept = np.array(solution.kept)
            print(f"{name}, {share:.0%} {kind}: wrong kept {(kept & wrong).sum()} of "
                  f"{wrong.sum()}, right kept {kept[~wrong].mean():.1%}, "
                  f"ATE {_ate(solution.world_from_anchor, truth):.4f} m, "
                  f"{wall:.1f} s ({cpu:.1f} s of processor)", flush=True)  # fmt: skip


def _ate(found: dict, truth: dict) -> float:
    a = np.array([found[name][:3, 3] for name in truth])
    b = np.array([pose[:3, 3] for pose in truth.values()])
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((a @ rotation.T - b) ** 2).sum(axis=1).mean()))


if __name__ == "__main__":
    main()
