"""`magic bench codec DATASET|RUN`: bytes per sub-map, and what the compact codec costs in PSNR.

Of a dataset one agent maps some frames; each sub-map is encoded losslessly and compactly, as it
goes over the wire, and both are decoded and rendered at the sub-map's own keyframes. Of a finished
run the sub-maps' bytes are what its agents reported, and the merged map is encoded and rendered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tyro.conf import Positional

from magic_cli.benchmarks.stored import is_run_folder
from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError
from magic_core.evaluation import RunFolder

if TYPE_CHECKING:
    from magic_core.data import FrameSource
    from magic_core.gaussians import GaussianCloud
    from magic_core.submap import Submap

_SHOWN = 0.5  # alpha from which a pixel counts: a sent sub-map lacks what the next one took over


@dataclass(frozen=True, slots=True)
class CodecBenchmark:
    """Options of `magic bench codec`."""

    dataset: Positional[str]
    """Folder of a dataset, or of a run."""
    scale: float = 1.0
    """Process images at this fraction of their size."""
    frames: int = 150
    """Frames of the first agent that are mapped."""
    submap_frames: int = 50
    """Frames per sub-map."""
    threads: int = 0
    """Threads of the rasteriser; 0 takes its own default."""
    json: bool = False
    """Print one JSON object as the last line."""

    def validate(self) -> None:
        """Raise ConfigError where there would be no sub-map."""
        if self.submap_frames < 2 or self.frames < 2:
            raise ConfigError.field("frames", "frames and submap_frames are at least 2")


def main(arguments: list[str]) -> int:
    """Map, encode, decode, compare."""
    config = parse(CodecBenchmark, arguments, prog="magic bench codec", description=__doc__ or "")
    config.validate()
    from magic_core.data import open_dataset

    if is_run_folder(Path(config.dataset)):
        result = _of_run(RunFolder(config.dataset), config.threads or None)
        console.print(_run_table(result))
        if config.json:
            print_json(result)
        return 0
    source = open_dataset(config.dataset, scale=config.scale, max_frames=config.frames)[0]
    rows = []
    with console.status("mapping") as status:
        for submap in _submaps(source, config):
            status.update(f"comparing sub-map {submap.index}")
            rows.append(_measured(submap, config.threads or None))
    result = {"submaps": rows, "mean": {
        key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "index"
    }}  # fmt: skip
    console.print(_table(source, result))
    if config.json:
        print_json(result)
    return 0


def _of_run(folder: RunFolder, threads: int | None) -> dict[str, Any]:
    """Bytes that the agents reported, and the merged map before and after the codec."""
    from magic_cli.benchmarks.merge import judge_of
    from magic_cli.benchmarks.stored import stored_sources
    from magic_core.evaluation.image_metrics import psnr
    from magic_core.gaussians import codec
    from magic_core.render import Rasteriser

    cloud, rasteriser = folder.read_map(), Rasteriser(threads)
    packed = codec.encode_compact(cloud)
    clouds = {"lossless": cloud, "compact": codec.decode(packed)}
    judge = judge_of(folder, 24, stored_sources(folder))
    shown = {
        f"{kind}_{name}_db": float(np.mean([
            psnr(rasteriser.render(chosen, v.camera, v.world_from_camera).colour, v.colour / 255.0)
            for v in views
        ]))
        for kind, views in (("train", judge.train), ("novel", judge.novel))
        for name, chosen in clouds.items()
    }  # fmt: skip
    sizes = [
        size
        for agent in folder.agents()
        if folder.agent_report_path(agent).is_file()
        for size in folder.read_agent_report(agent).wire_bytes
    ]
    return {
        "submaps": len(sizes),
        "compact_bytes": float(np.mean([size.compact for size in sizes])),
        "lossless_bytes": float(np.mean([size.lossless for size in sizes])),
        "gaussians": len(cloud),
        "map_compact_bytes": len(packed),
        "map_lossless_bytes": len(codec.encode_lossless(cloud)),
        **shown,
        "cost_db": {
            kind: shown[f"{kind}_lossless_db"] - shown[f"{kind}_compact_db"]
            for kind in ("train", "novel")
        },
    }


def _run_table(result: dict[str, Any]):
    rows = [
        ["lossless", f"{result['lossless_bytes'] / 1e6:.2f} MB",
         f"{result['map_lossless_bytes'] / 1e6:.2f} MB", f"{result['train_lossless_db']:.3f} dB",
         f"{result['novel_lossless_db']:.3f} dB"],
        ["compact", f"{result['compact_bytes'] / 1e6:.2f} MB",
         f"{result['map_compact_bytes'] / 1e6:.2f} MB", f"{result['train_compact_db']:.3f} dB",
         f"{result['novel_compact_db']:.3f} dB"],
    ]  # fmt: skip
    title = f"{result['submaps']} sub-maps and their map of {result['gaussians']:,} Gaussians"
    return table(title, ["", "per sub-map", "map", "keyframes", "new views"], rows)


def _submaps(source: FrameSource, config: CodecBenchmark) -> Iterator[Submap]:
    from magic_agent.places import load_descriptor_model
    from magic_agent.slam import LocalSlam
    from magic_agent.slam_config import SlamConfig, SubmapConfig

    limits = SubmapConfig(
        frames=config.submap_frames, min_frames=min(15, config.submap_frames), translation_m=1e3,
        rotation_deg=180.0, min_anchor_overlap=0.0,
    )  # fmt: skip
    slam = LocalSlam(
        source.camera, SlamConfig(submap=limits, threads=config.threads), session="bench",
        agent=source.name, describe=load_descriptor_model("efficientnet_lite0").describe,
    )  # fmt: skip
    for frame in source:
        finished = slam.process(frame).finished
        if finished is not None:
            yield finished
    last = slam.finish()
    if last is not None:
        yield last


def _measured(submap: Submap, threads: int | None) -> dict[str, Any]:
    from magic_core.gaussians import codec
    from magic_core.wire import SubmapEncoding, encode_submap

    compact = encode_submap(submap, request_id="bench", encoding=SubmapEncoding())
    lossless = encode_submap(submap, request_id="bench", encoding=SubmapEncoding.lossless())
    packed = codec.encode_compact(submap.gaussians)
    before = _psnr(submap, submap.gaussians, submap.gaussians, threads)
    after = _psnr(submap, codec.decode(packed), submap.gaussians, threads)
    return {
        "index": submap.index,
        "frames": len(submap.trajectory),
        "keyframes": len(submap.keyframes),
        "gaussians": len(submap.gaussians),
        "compact_bytes": compact.wire_bytes,
        "lossless_bytes": lossless.wire_bytes,
        "gaussian_bytes": len(packed),
        "psnr_lossless_db": before,
        "psnr_compact_db": after,
        "cost_db": before - after,
    }


def _psnr(
    submap: Submap, cloud: GaussianCloud, original: GaussianCloud, threads: int | None
) -> float:
    """Mean PSNR at the keyframes, where the sub-map as it was shows anything."""
    from magic_core.render import Rasteriser

    rasteriser, figures = Rasteriser(threads), []
    for keyframe in submap.keyframes:
        pose = keyframe.anchor_from_camera
        shown = rasteriser.render(original, submap.camera, pose).alpha > _SHOWN
        if shown.any():
            colour = rasteriser.render(cloud, submap.camera, pose).colour.clip(0.0, 1.0)
            error = colour[shown] - keyframe.colour[shown] / 255.0
            figures.append(-10.0 * np.log10(max(float(np.mean(error**2)), 1e-10)))
    return float(np.mean(figures)) if figures else float("nan")


def _table(source: FrameSource, result: dict[str, Any]):
    columns = ["sub-map", "frames", "keyframes", "Gaussians", "compact", "lossless",
               "PSNR lossless", "compact", "cost"]  # fmt: skip
    rows = [
        [str(row.get("index", "mean")), f"{row['frames']:.0f}", f"{row['keyframes']:.0f}",
         f"{row['gaussians']:,.0f}", f"{row['compact_bytes'] / 1e6:.2f} MB",
         f"{row['lossless_bytes'] / 1e6:.2f} MB", f"{row['psnr_lossless_db']:.2f} dB",
         f"{row['psnr_compact_db']:.2f} dB", f"{row['cost_db']:.3f} dB"]
        for row in (*result["submaps"], result["mean"])
    ]  # fmt: skip
    camera = source.camera
    return table(f"Sub-maps of {camera.width}x{camera.height}", columns, rows)
