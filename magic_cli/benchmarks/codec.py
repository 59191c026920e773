"""`magic bench codec DATASET`: bytes per sub-map, and what the compact codec costs in PSNR.

One agent maps the data; each sub-map is encoded losslessly and compactly, as it goes over the wire,
and both are decoded and rendered at the sub-map's own keyframes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import ConfigError

if TYPE_CHECKING:
    from magic_core.data import FrameSource
    from magic_core.gaussians import GaussianCloud
    from magic_core.submap import Submap

_SHOWN = 0.5  # alpha from which a pixel counts: a sent sub-map lacks what the next one took over


@dataclass(frozen=True, slots=True)
class CodecBenchmark:
    """Options of `magic bench codec`."""

    dataset: Positional[str]
    """Folder of a dataset."""
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
