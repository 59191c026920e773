"""`magic bench viewer`: what watching costs, in processor time and bytes, with a large map.

A session of random Gaussians along a corridor is shown on a page that one visitor reads. Processor
time is that of the viewer's process alone.

Examples:
  magic bench viewer --json
  magic bench viewer --gaussians 4000000      # more than are sent: they are merged
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError

if TYPE_CHECKING:
    from magic_cli.viewer.model import SessionView, SubmapView

_QUIET_S = 1.5
"""The visitor has everything when nothing came for so long."""
_PER_AGENT = 10


@dataclass(frozen=True, slots=True)
class ViewerBenchmark:
    """Options of `magic bench viewer`."""

    gaussians: int = 1_000_000
    """Gaussians of the whole session."""
    submaps: int = 50
    """Sub-maps that they are spread over, ten of an agent."""
    max_splats: int = 1_000_000
    """As `magic view --max-splats`."""
    frames: int = 50
    """Tracked frames of each sub-map."""
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(slots=True)
class Visitor:
    """One reader of the page, which counts what it gets."""

    received: int = 0
    """Bytes."""
    newest_s: float = 0.0
    """When something came last, by the monotonic clock."""

    def read(self, address: str) -> None:
        """Read until the page is closed."""
        import viser
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        protocol = Subprotocol(f"viser-v{viser.__version__}")
        with connect(address, subprotocols=[protocol], max_size=None, compression=None) as socket:
            try:
                for message in socket:
                    self.received += len(message)
                    self.newest_s = time.monotonic()
            except ConnectionClosed:
                return

    def settle(self) -> None:
        """Wait until nothing more comes."""
        self.newest_s = time.monotonic()
        while time.monotonic() - self.newest_s < _QUIET_S:
            time.sleep(0.05)


def main(arguments: list[str]) -> int:
    """Run the benchmark and print its table."""
    config = parse(ViewerBenchmark, arguments, prog="magic bench viewer", description=__doc__ or "")
    if min(config.gaussians, config.submaps, config.max_splats, config.frames) < 1:
        raise ConfigError("gaussians, submaps, max_splats, frames: expected at least 1 of each")
    result = run(config)
    rows = [
        [name, f"{1e3 * cell['cpu_s']:,.0f} ms", f"{cell['bytes']:,}"]
        for name, cell in result["updates"].items()
    ]
    console.print(table(f"{config.gaussians:,} Gaussians in {config.submaps} sub-maps",
                        ["update", "processor time", "bytes to each visitor"], rows))  # fmt: skip
    if config.json:
        print_json(result)
    return 0


def run(config: ViewerBenchmark) -> dict:
    """Processor time and bytes of the kinds of updates that a page gets."""
    from magic_cli.viewer.page import Page

    view = _session(config)
    last = next(reversed(view.submaps))
    kept = view.submaps.pop(last)
    page = Page(host="127.0.0.1", port=0, max_splats=config.max_splats)
    visitor = Visitor()
    try:
        address = page.address.replace("http://", "ws://")
        threading.Thread(target=visitor.read, args=(address,), daemon=True).start()
        visitor.settle()
        updates = {
            "the whole map": _cost(visitor, lambda: page.update(view)),
            "nothing new": _cost(visitor, lambda: page.update(view)),
            "one sub-map more": _cost(visitor, lambda: _arrive(page.update, view, kept)),
            "a correction that moves all": _cost(visitor, lambda: _correct(page.update, view)),
        }
    finally:
        page.close()
    return {**{k: v for k, v in dataclasses.asdict(config).items() if k != "json"},
            "updates": updates}  # fmt: skip


def _cost(visitor: Visitor, update: Callable[[], None]) -> dict[str, float]:
    before, start = visitor.received, time.process_time()
    update()
    drawn_s = time.process_time() - start
    visitor.settle()
    return {
        "cpu_s": round(time.process_time() - start, 4),
        "update_cpu_s": round(drawn_s, 4),
        "bytes": visitor.received - before,
    }


def _arrive(draw: Callable[[SessionView], None], view: SessionView, submap: SubmapView) -> None:
    view.submaps[submap.name] = submap
    draw(view)


def _correct(draw: Callable[[SessionView], None], view: SessionView) -> None:
    from magic_core.geometry import se3

    assert view.snapshot is not None
    moved = se3.exp([0.05, 0.0, 0.02, 0.0, 0.01, 0.0])
    poses = {
        name: dataclasses.replace(pose, world_from_anchor=moved @ pose.world_from_anchor)
        for name, pose in view.snapshot.poses.items()
    }
    revision = view.snapshot.revision + 1
    view.snapshot = dataclasses.replace(view.snapshot, poses=poses, revision=revision)
    draw(view)


def _session(config: ViewerBenchmark) -> SessionView:
    """Sub-maps along a corridor, each with Gaussians on the walls around it."""
    from magic_cli.viewer.model import SessionView
    from magic_core.geometry import se3
    from magic_core.wire import names, records

    rng = np.random.default_rng(0)
    view, poses = SessionView("bench"), {}
    counts = np.diff(np.linspace(0, config.gaussians, config.submaps + 1).astype(int))
    component = names.submap_name("bench", "agent_0", 0)
    for number, count in enumerate(counts):
        agent, index = f"agent_{number // _PER_AGENT}", number % _PER_AGENT
        submap = _submap(names.submap_name("bench", agent, index), agent, index, int(count),
                         config.frames, rng)  # fmt: skip
        pose = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 2.0 * number])
        view.submaps[submap.name] = submap
        poses[submap.name] = records.CorrectedPose(submap.name, component, pose)
    agents = tuple(sorted({names.agent_name("bench", s.agent) for s in view.submaps.values()}))
    info = records.ComponentInfo(component, len(poses), agents)
    view.snapshot = records.PoseSnapshot("sessions/bench", 1, None, poses, (info,))
    return view


def _submap(
    name: str, agent: str, index: int, count: int, frames: int, rng: np.random.Generator
) -> SubmapView:
    from magic_cli.viewer.model import SubmapView, extent_of
    from magic_core.gaussians import GaussianCloud
    from magic_core.geometry import Camera, se3
    from magic_core.submap import Keyframe

    camera = Camera(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
    quaternions = rng.normal(size=(count, 4)).astype(np.float32)
    cloud = GaussianCloud.from_arrays(
        rng.uniform([-2.0, -0.6, 0.0], [2.0, 0.6, 2.0], (count, 3)).astype(np.float32),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        scales=rng.uniform(0.005, 0.03, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 1.0, count).astype(np.float32),
        colours=rng.uniform(0.0, 1.0, (count, 3)).astype(np.float32),
    )
    path = np.tile(np.eye(4), (frames, 1, 1))
    path[:, 2, 3] = np.linspace(0.0, 2.0, frames)
    colour = rng.integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
    depth = np.ones((camera.height, camera.width), np.float32)
    keyframe = Keyframe(0, 0.0, se3.identity(), colour, depth)
    step = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 2.0])
    previous = (index - 1, step) if index else None
    return SubmapView(
        name=name,
        agent=agent,
        index=index,
        camera=camera,
        cloud=cloud,
        path=path,
        times_s=tuple(0.1 * k for k in range(frames)),
        frame_indices=tuple(range(frames)),
        keyframes=(keyframe,),
        previous=previous,
        extent=extent_of(cloud, path),
    )
