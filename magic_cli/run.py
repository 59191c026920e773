"""`magic run DATASET`: map a dataset on this machine, end to end.

Starts a server and one process per agent_* folder, waits until all agents are done, merges the
map, and writes one run folder with trajectories, map, metrics and an HTML report.

Examples:
  magic run ~/recordings/office --scale 0.5
  magic run ~/recordings/office --viewer --rerun office.rrd
  magic run DATASET --tracking.solver adam --json
  magic run DATASET --config runs/office/config.yaml --out runs/again

Ctrl-C ends early: agents send what they have, it is merged, and the run folder is complete. While
merging, Ctrl-C keeps the sub-maps as they were sent. Exit codes: 0 done, 1 failed, 2 usage, 130 by
a further Ctrl-C.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from magic_agent.config import AgentConfig
from magic_cli.options import parse
from magic_cli.output import console, print_json
from magic_core.config import field_names, save_yaml
from magic_core.errors import ConfigError
from magic_server.access import AccessConfig
from magic_server.config import ListenConfig, ServerConfig
from magic_server.globalmap import MergeConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.posegraph import PoseGraphConfig
from magic_server.registration import RegistrationConfig

WORTH_SAYING_S = 5.0
"""Loading compiled kernels takes less; compiling them takes more, and is said."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig(AgentConfig):
    """Options of `magic run`."""

    dataset: Positional[str]
    """Folder of a dataset, or synthetic://flat?agents=3&frames=120."""
    out: Path | None = None
    """Run folder; default runs/{dataset}-{time}."""
    scale: float = 1.0
    """Process images at this fraction of their size."""
    frames: int | None = None
    """Use only so many frames of each agent."""
    stride: int = 1
    """Use every n-th frame."""
    loops: Literal["on", "off"] = "on"
    """`off` leaves loop closure out: every agent keeps its own odometry (an ablation)."""
    merge_timeout_s: float = 3600.0
    """Longest wait for the merged map."""
    report: bool = True
    """Write report.html and overview.png."""
    viewer: bool = False
    """Show the map in the browser while it grows; `magic view RUN` shows it again afterwards."""
    viewer_port: int = 8080
    """Port of the page, on this machine alone; the next free one where it is taken."""
    viewer_splats: int = 1_000_000
    """Gaussians sent to the browser at most; without a GPU 100000 are drawn smoothly."""
    rerun: Path | None = None
    """Write the run to this Rerun recording (.rrd) as it goes; needs the extra `rerun`."""
    lpips_weights: Path | None = None
    """AlexNet weights for LPIPS (safetensors); default: MAGIC_LPIPS_WEIGHTS or the usual places."""
    candidates: LoopConfig = field(default_factory=LoopConfig)
    """Server: which similar places are verified."""
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    """Server: how two places are registered and what is believed."""
    posegraph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    """Server: how the pose graph is solved."""
    merge: MergeConfig = field(default_factory=MergeConfig)
    """Server: how the global map is made."""
    jobs: JobConfig = field(default_factory=JobConfig)
    """Server: its worker processes."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Run a dataset; 0 when a map was made."""
    config = parse(RunConfig, arguments, prog="magic run", description=__doc__ or "")
    config.validate()
    metrics = run(config)
    if config.json:
        print_json(metrics)
    return 0


def run(config: RunConfig) -> dict:
    """Run a dataset and return its metrics (the contract of `magic run --json`)."""
    from magic_cli.local_run import LocalRun
    from magic_cli.summary import print_summary
    from magic_core.data import open_dataset
    from magic_core.evaluation import RunFolder

    start = time.perf_counter()
    _refuse_live(config.dataset)
    if config.rerun is not None:
        from magic_cli.viewer.recording import require_rerun

        require_rerun(config.rerun)
    sources = open_dataset(
        config.dataset, scale=config.scale, max_frames=config.frames, stride=config.stride
    )
    folder = RunFolder(config.out or default_out(config.dataset)).create()
    save_yaml(config, folder.config_path)
    compile_kernels()
    try:
        outcome = asyncio.run(LocalRun(config, sources, folder).run())
    except asyncio.CancelledError:  # by a Ctrl-C that came too early, or once more
        raise KeyboardInterrupt from None
    from magic_cli.evaluation import measure

    metrics = measure(
        folder,
        sources,
        outcome=outcome,
        report=config.report,
        started=start,
        lpips_weights=config.lpips_weights,
    )
    print_summary(metrics, folder)
    return metrics


def _refuse_live(dataset: str) -> None:
    """A run reads its frames again to measure; what a camera showed is gone by then."""
    if dataset.startswith("realsense:"):
        raise ConfigError(
            f"{dataset}: a live camera cannot be read twice; start `magic serve --data-dir DIR` "
            f"and then `magic agent {dataset} --server HOST:PORT`"
        )


def compile_kernels() -> None:
    """Compile the kernels once, here, so that no agent's first frame waits for it unannounced."""
    from magic_agent.warmup import warm_up_slam

    with console.status("compiling or loading the kernels for this processor") as status:
        report = warm_up_slam(progress=status.update)
    if report.total_s > WORTH_SAYING_S:
        where = report.cache_folder or "memory: no cache folder can be written"
        console.print(f"Kernels compiled in {report.total_s:.0f} s, kept in {where}")


def default_out(dataset: str) -> Path:
    """runs/{dataset}-{local time}."""
    name = Path(dataset.split("?", 1)[0].split("://")[-1]).name or "run"
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def agent_settings(config: RunConfig) -> dict:
    """The settings that a run hands on to its agents."""
    return {name: getattr(config, name) for name in field_names(AgentConfig)}


def server_settings(config: RunConfig, folder: Path) -> ServerConfig:
    """The settings of the run's server: on loopback, on any free port, its store in `folder`."""
    return ServerConfig(
        data_dir=folder,
        listen=ListenConfig(port=0),
        access=AccessConfig(tokens_env=""),  # callers of another server are none of this one's
        jobs=config.jobs,
        loops=dataclasses.replace(config.candidates, enabled=config.loops == "on"),
        registration=config.registration,
        posegraph=config.posegraph,
        merge=config.merge,
    )
