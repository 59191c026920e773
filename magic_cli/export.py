"""`magic export RUN --what WHAT --out PATH`: a run's results in other tools' formats.

  map           ply (standard 3DGS), compressed-ply (SuperSplat), spz, compact or lossless (ours)
  mesh          ply or glb, fused from rendered depth and colour
  points        ply: the Gaussians' means with normals and colours
  trajectories  tum or kitti, one file per agent
  posegraph     g2o
  rerun         rrd: a Rerun recording of sub-maps, keyframe images, trajectories and loops

`--axes` says what x, y and z of the file point to: (r)ight or (l)eft, (u)p or (d)own, (f)orward or
(b)ack, of the first camera. Ours are rdf; ROS has flu, Unity ruf, glTF and SPZ want rub.

`--region` (of the map and its points) takes what lies in a box, lowest x y z and highest x y z in
metres, in our axes whatever those of the file. `--max-gaussians` merges neighbours that are alike
until so many are left, so that the picture stays whole.

Examples:
  magic export runs/demo --what mesh --out scene.glb
  magic export runs/demo --what map --out scene.ply --axes rub
  magic export runs/demo --out corner.ply --region 0 -2 0 3 1 4 --max-gaussians 50000
  magic export runs/demo --what trajectories --format kitti --out kitti/
  magic export runs/demo --what rerun --out demo.rrd
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json
from magic_core.errors import ConfigError, NotFound
from magic_core.evaluation import RunFolder, write_kitti, write_tum
from magic_core.gaussians import GaussianCloud
from magic_core.geometry.axes import OURS, axes_from_ours
from magic_server.globalmap import MeshConfig

FORMATS = {
    "map": ("ply", "compressed-ply", "spz", "compact", "lossless"),
    "mesh": ("ply", "glb"),
    "points": ("ply",),
    "trajectories": ("tum", "kitti"),
    "posegraph": ("g2o",),
    "rerun": ("rrd",),
}
_OF_SUFFIX = {".glb": "glb", ".spz": "spz"}
_SPECIFIED_AXES = {"glb": "rub", "spz": "rub"}
_IN_PART = ("map", "points")
_RERUN_POINTS = 1_000_000
_DIRECTION = {"r": "right", "l": "left", "u": "up", "d": "down", "f": "forward", "b": "back"}


@dataclass(frozen=True, slots=True)
class ExportConfig:
    """Options of `magic export`."""

    run: Positional[Path]
    """Run folder."""
    out: Path
    """File to write; for trajectories a folder."""
    what: Literal["map", "mesh", "points", "trajectories", "posegraph", "rerun"] = "map"
    """What to write."""
    format: (
        Literal[
            "ply",
            "compressed-ply",
            "spz",
            "compact",
            "lossless",
            "glb",
            "tum",
            "kitti",
            "g2o",
            "rrd",
        ]
        | None
    ) = None
    """Default: what the file's suffix says, else the first of those listed above."""
    axes: str | None = None
    """Axes of the file, such as rdf, rub, flu or ruf; default rdf, but rub for glb and spz, whose
    specifications say so."""
    region: tuple[float, float, float, float, float, float] | None = None
    """Map and points: only what lies in this box, lowest x y z and highest x y z in metres, in the
    axes of the map (rdf)."""
    max_gaussians: int = 0
    """Map and points: at most so many; neighbours that are alike are merged. 0: all."""
    kind: Literal["tracked", "corrected", "ground_truth"] = "corrected"
    """Which trajectories: odometry alone, after the pose graph, or the data's own."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """How the mesh is made."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Write the chosen files and list them."""
    config = parse(ExportConfig, arguments, prog="magic export", description=__doc__ or "")
    chosen = _chosen_format(config)
    _check_part(config)
    axes = (config.axes or _SPECIFIED_AXES.get(chosen, OURS)).lower()
    matrix = axes_from_ours(axes)
    folder = RunFolder(config.run)
    if config.what != "trajectories":
        config.out.parent.mkdir(parents=True, exist_ok=True)
    write = {
        "map": _map,
        "mesh": _mesh,
        "points": _points,
        "trajectories": _trajectories,
        "posegraph": _posegraph,
        "rerun": _rerun,
    }[config.what]
    written = write(folder, config, chosen, matrix)
    for path in written:
        console.print(f"Written: {path} ({chosen}, axes {named_axes(axes)})", soft_wrap=True)
    if config.json:
        print_json({"written": [str(path) for path in written], "format": chosen, "axes": axes})
    return 0


def named_axes(axes: str) -> str:
    """`x right, y down, z forward` of `rdf`."""
    return ", ".join(
        f"{name} {_DIRECTION[letter]}" for name, letter in zip("xyz", axes, strict=True)
    )


def _chosen_format(config: ExportConfig) -> str:
    possible = FORMATS[config.what]
    by_suffix = _OF_SUFFIX.get(config.out.suffix.lower(), possible[0])
    chosen = str(config.format or (by_suffix if by_suffix in possible else possible[0]))
    if chosen not in possible:
        choices = ", ".join(possible)
        raise ConfigError(f"--format {chosen}: {config.what} can be written as {choices}")
    return chosen


def _check_part(config: ExportConfig) -> None:
    if config.max_gaussians < 0:
        raise ConfigError(f"--max-gaussians {config.max_gaussians}: expected 0 or more")
    if config.what not in _IN_PART and (config.region or config.max_gaussians):
        raise ConfigError(
            f"--region and --max-gaussians are for {' and '.join(_IN_PART)}, not {config.what}"
        )


def _map(folder: RunFolder, config: ExportConfig, chosen: str, matrix: np.ndarray) -> list[Path]:
    cloud = _oriented_map(folder, config, matrix)
    if chosen == "ply":
        from magic_core.gaussians.ply import write_ply

        axes = named_axes(config.axes or OURS)
        return [write_ply(config.out, cloud, axes=f"{axes} of the first camera")]
    if chosen in ("compressed-ply", "spz"):
        from magic_core.gaussians.splats import write_splats

        return [write_splats(config.out, cloud, chosen)]
    from magic_core.gaussians import codec

    encode = codec.encode_compact if chosen == "compact" else codec.encode_lossless
    config.out.write_bytes(encode(cloud))
    return [config.out]


def _oriented_map(folder: RunFolder, config: ExportConfig, matrix: np.ndarray) -> GaussianCloud:
    """What is wanted of the map, in the file's axes."""
    from magic_core.gaussians.reduction import reduced
    from magic_core.gaussians.region import Region

    cloud = folder.read_map()
    if config.region is not None:
        x, y, z, *high = config.region
        cloud = cloud.select(Region((x, y, z), (high[0], high[1], high[2])).holds(cloud.means))
        if not len(cloud):
            raise NotFound(f"--region {' '.join(map(str, config.region))}: no Gaussian lies in it")
    if config.max_gaussians:
        cloud = reduced(cloud, config.max_gaussians)
    return cloud if np.array_equal(matrix, np.eye(3)) else cloud.reoriented(matrix)


def _points(folder: RunFolder, config: ExportConfig, chosen: str, matrix: np.ndarray) -> list[Path]:
    from magic_core.gaussians.points import write_points

    cloud = _oriented_map(folder, config, matrix)
    comment = f"axes {named_axes(config.axes or OURS)} of the first camera"
    return [write_points(config.out, cloud.select(cloud.opacities >= 0.5), comment=comment)]


def _mesh(folder: RunFolder, config: ExportConfig, chosen: str, matrix: np.ndarray) -> list[Path]:
    from magic_core.evaluation.accuracy import main_component_trajectories
    from magic_server.globalmap.mesh import mesh_of
    from magic_server.globalmap.mesh_file import write_mesh

    trajectories = main_component_trajectories(folder)
    if not trajectories:
        raise NotFound(f"{folder.path}: no corrected trajectory; is this a finished run?")
    camera = folder.read_agent_report(next(iter(trajectories))).camera
    poses = np.concatenate([t.world_from_camera for t in trajectories.values()])
    cloud = folder.read_map()
    with console.status("fusing rendered depth") as status:
        mesh = mesh_of(
            cloud, camera, poses, config.mesh,
            progress=lambda share: status.update(f"fusing rendered depth: {share:.0%}"),
        )  # fmt: skip
    return [write_mesh(config.out, mesh.reoriented(matrix), "glb" if chosen == "glb" else "ply")]


def _trajectories(
    folder: RunFolder, config: ExportConfig, chosen: str, matrix: np.ndarray
) -> list[Path]:
    written = []
    for agent in folder.agents():
        if folder.has_trajectory(agent, config.kind):
            config.out.mkdir(parents=True, exist_ok=True)
            path = config.out / f"{agent}.txt"
            write = write_kitti if chosen == "kitti" else write_tum
            write(path, folder.read_trajectory(agent, config.kind).reoriented(matrix))
            written.append(path)
    if not written:
        raise NotFound(f"{folder.path}: no {config.kind} trajectory; is this a finished run?")
    return written


def _rerun(folder: RunFolder, config: ExportConfig, chosen: str, matrix: np.ndarray) -> list[Path]:
    import asyncio

    from magic_cli.view import record

    if not np.array_equal(matrix, np.eye(3)):
        raise ConfigError(f"--axes {config.axes}: a recording declares its axes itself, as {OURS}")
    with console.status("reading the stored session"):
        asyncio.run(record(folder.path, config.out, max_points=_RERUN_POINTS))
    return [config.out]


def _posegraph(
    folder: RunFolder, config: ExportConfig, chosen: str, matrix: np.ndarray
) -> list[Path]:
    from magic_core.geometry.axes import reoriented_information, reoriented_poses
    from magic_server.posegraph.g2o import read_g2o, write_g2o

    if not folder.posegraph_path.is_file():
        raise NotFound(f"{folder.posegraph_path}: not in this run folder; did the run finish?")
    graph = read_g2o([folder.posegraph_path])
    poses = {key: reoriented_poses(pose, matrix) for key, pose in graph.poses.items()}
    edges = [
        (i, j, reoriented_poses(motion, matrix), reoriented_information(information, matrix))
        for i, j, motion, information in graph.edges
    ]
    write_g2o(config.out, poses, edges)
    return [config.out]
