"""`magic render RUN --trajectory WAY --out FILE`: new views from a run's map.

WAY is a TUM file of camera poses in the map's frame, `orbit` (once round the map from above, walls
that hide it left out), or an agent's name (where its camera went).

Examples:
  magic render runs/demo --trajectory orbit --out orbit.mp4
  magic render runs/demo --trajectory agent_0 --out frames/ --width 1280
  magic render runs/demo --trajectory path.txt --out path.mp4 --fps 24
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json
from magic_core.errors import ConfigError, NotFound
from magic_core.evaluation import RunFolder, Trajectory, read_tum

if TYPE_CHECKING:
    from magic_core.geometry import Camera

ORBIT = "orbit"
_MAX_SIDE = 8192


@dataclass(frozen=True, slots=True)
class RenderConfig:
    """Options of `magic render`."""

    run: Positional[Path]
    """Run folder."""
    out: Path
    """A .mp4 or .webm file, or a folder for numbered PNG files."""
    trajectory: str = ORBIT
    """`orbit`, an agent's name, or a TUM file of world_from_camera poses in the map's frame."""
    width: int = 960
    """Width of the pictures, pixels; their height follows from the camera's, rounded to even."""
    fps: float = 30.0
    """Frames per second of the video."""
    seconds: float = 10.0
    """Length of the orbit; a trajectory gives one picture per pose."""
    coarse: bool = False
    """Show the map as it was before the fine stage of merging."""
    threads: int = 0
    """Threads of the rasteriser; 0 takes its own default."""
    json: bool = False
    """Print one JSON object as the last line."""

    def validate(self) -> None:
        """Raise ConfigError naming the first value that nothing can be rendered with."""
        if not 16 <= self.width <= _MAX_SIDE:
            raise ConfigError.field("width", f"{self.width}: expected 16 to {_MAX_SIDE} pixels")
        if not 0 < self.fps <= 240:
            raise ConfigError.field("fps", f"{self.fps}: expected above 0, at most 240")
        if not 0 < self.seconds <= 3600:
            raise ConfigError.field("seconds", f"{self.seconds}: expected above 0, at most 3600")


def main(arguments: list[str]) -> int:
    """Render and say what was written."""
    config = parse(RenderConfig, arguments, prog="magic render", description=__doc__ or "")
    config.validate()
    from magic_core.evaluation.video import VIDEO_SUFFIXES, write_frames, write_video

    folder = RunFolder(config.run)
    is_video = config.out.suffix.lower() in VIDEO_SUFFIXES
    if config.out.suffix and not is_video:
        raise ConfigError.field("out", f"{config.out}: expected .mp4, .webm or a folder")
    camera, count, pictures = _pictures(folder, config)
    with console.status("rendering") as status:
        shown = _counted(pictures, lambda n: status.update(f"rendering {n} of {count}"))
        if is_video:
            size = (camera.width, camera.height)
            written = write_video(config.out, shown, size=size, fps=config.fps)
        else:
            written = write_frames(config.out, shown)
    console.print(f"Written: {config.out} ({written} pictures, {camera.width}x{camera.height})",
                  soft_wrap=True)  # fmt: skip
    if config.json:
        print_json({"written": str(config.out), "frames": written,
                    "width": camera.width, "height": camera.height})  # fmt: skip
    return 0


def _pictures(folder: RunFolder, config: RenderConfig) -> tuple[Camera, int, Iterator[np.ndarray]]:
    """The camera, how many pictures there will be, and the pictures as they are rendered."""
    from magic_core.evaluation.accuracy import main_component_trajectories
    from magic_core.evaluation.overview import cut_open, on_ground, scene_of
    from magic_core.evaluation.vantage import orbit_poses, outside_camera
    from magic_core.render import Rasteriser

    cloud = folder.read_coarse_map() if config.coarse else folder.read_map()
    rasteriser = Rasteriser(config.threads or None)
    if config.trajectory == ORBIT:
        walks = main_component_trajectories(folder)
        if not walks:
            raise NotFound(f"{folder.path}: no corrected trajectory; is this a finished run?")
        agent_camera = folder.read_agent_report(next(iter(walks))).camera
        scene = scene_of(cloud, agent_camera, walks, rasteriser)
        camera = outside_camera(_even(config.width), _even(config.width * 2 / 3))
        poses = orbit_poses(scene, camera, count=max(1, round(config.seconds * config.fps)))
        return camera, len(poses), (cut_open(scene, camera, p, rasteriser) for p in poses)
    camera = _scaled_camera(folder, config.width)
    poses = _trajectory(folder, config.trajectory).world_from_camera
    return camera, len(poses), (on_ground(rasteriser.render(cloud, camera, p)) for p in poses)


def _trajectory(folder: RunFolder, given: str) -> Trajectory:
    if Path(given).is_file():
        found = read_tum(given)
    elif folder.has_trajectory(given, "corrected"):
        found = folder.read_trajectory(given, "corrected")
    else:
        agents = ", ".join(folder.agents()) or "none"
        raise NotFound(
            f"--trajectory {given}: no file, not `orbit`, and no agent of this run ({agents})"
        )
    if not len(found):
        raise ConfigError.field("trajectory", f"{given}: holds no pose")
    return found


def _scaled_camera(folder: RunFolder, width: int) -> Camera:
    from magic_core.geometry import Camera

    agents = [name for name in folder.agents() if folder.agent_report_path(name).is_file()]
    if not agents:
        raise NotFound(f"{folder.path}: no agent left a report that says what its camera is")
    own = folder.read_agent_report(agents[0]).camera
    camera = own.scaled(_even(width) / own.width)
    return Camera(width=_even(camera.width), height=_even(camera.height), fx=camera.fx,
                  fy=camera.fy, cx=camera.cx, cy=camera.cy)  # fmt: skip


def _even(pixels: float) -> int:
    return max(2, 2 * round(pixels / 2))


def _counted(pictures: Iterator[np.ndarray], said) -> Iterator[np.ndarray]:
    for number, picture in enumerate(pictures, start=1):
        yield picture
        said(number)
