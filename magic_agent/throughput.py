"""`magic bench agent`: frames per second of one whole agent, without a server.

What an agent does is done here in the same arrangement: frames are read ahead on one thread,
tracked and mapped on another, and finished sub-maps are described, encoded both ways and left to
be sent on a third. Only the sending itself is missing.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from magic_agent.config import AgentConfig
from magic_agent.places import DescriptorModel, load_descriptor_model
from magic_agent.places.keyframes import with_described_keyframes
from magic_agent.slam import FrameResult, LocalSlam
from magic_agent.tally import peak_rss_bytes
from magic_core.data import Frame, FrameSource, open_dataset
from magic_core.errors import ConfigError
from magic_core.render import warm_up
from magic_core.render.threads import available_cores
from magic_core.submap import Submap
from magic_core.wire import SubmapEncoding, encode_submap

Progress = Callable[[str], None]
_WARM_FRAMES = 3


@dataclass(slots=True)
class AgentSpeed:
    """How fast one agent went through its recording."""

    frames: int = 0
    lost_frames: int = 0
    keyframes: int = 0
    submaps: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    submap_ends_s: list[float] = field(default_factory=list)
    submap_frames: list[int] = field(default_factory=list)
    tracking_ms: list[float] = field(default_factory=list)
    mapping_ms: list[float] = field(default_factory=list)
    encoding_s: float = 0.0
    waiting_s: float = 0.0
    """Time that tracking waited for a frame to be read."""

    def summary(self) -> dict:
        """Ready for JSON; times per frame are means."""
        per_frame = 1e3 / max(self.frames, 1)
        return {
            "frames": self.frames,
            "lost_frames": self.lost_frames,
            "keyframes": self.keyframes,
            "submaps": self.submaps,
            "fps": self.frames / self.wall_s,
            "slowest_submap_fps": min(self._submap_fps()),
            "wall_ms_per_frame": self.wall_s * per_frame,
            "cpu_ms_per_frame": self.cpu_s * per_frame,
            "stages_ms_per_frame": {
                "waiting for a frame": self.waiting_s * per_frame,
                "tracking": float(np.mean(self.tracking_ms)),
                "mapping and hand-over": float(np.mean(self.mapping_ms)),
                "encoding, beside them": self.encoding_s * per_frame,
            },
        }

    def _submap_fps(self) -> Iterator[float]:
        begins_s = [0.0, *self.submap_ends_s[:-1]]
        spans = zip(begins_s, self.submap_ends_s, self.submap_frames, strict=True)
        return (frames / (end_s - begin_s) for begin_s, end_s, frames in spans)


def run(
    dataset: Path | str,
    *,
    threads: int,
    scale: float = 0.5,
    frames: int | None = None,
    config: AgentConfig | None = None,
    progress: Progress = lambda text: None,
) -> dict:
    """Run each recording of a dataset alone, on `threads` cores; the result is ready for JSON.

    `fps` is that of the slowest agent.
    """
    config = config or AgentConfig(threads=threads)
    with confined(threads) as cores:
        warm_up()
        model = load_descriptor_model(config.places_model)
        agents = {}
        for source in open_dataset(dataset, scale=scale, max_frames=frames):
            agents[source.name] = found = measure(source, config, model).summary()
            progress(
                f"{source.name}: {found['fps']:.1f} frames/s over {found['frames']} frames, "
                f"slowest sub-map {found['slowest_submap_fps']:.1f}"
            )
    return {
        "dataset": str(dataset),
        "scale": scale,
        "threads": threads,
        "cores": cores,
        "fps": min(found["fps"] for found in agents.values()),
        "slowest_submap_fps": min(found["slowest_submap_fps"] for found in agents.values()),
        "peak_rss_bytes": peak_rss_bytes(),
        "agents": agents,
    }


@contextmanager
def confined(threads: int) -> Iterator[int | None]:
    """Kernel threads set to a number, and this process to as many cores where the system can.

    Yields the number of cores, None where it cannot be set.
    """
    if not 1 <= threads <= available_cores():
        raise ConfigError.field("threads", f"{threads}: expected 1 to {available_cores()} cores")
    before = os.environ.get("MAGIC_THREADS")
    os.environ["MAGIC_THREADS"] = str(threads)
    all_cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    try:
        if all_cores is not None:
            _set_cores(set(sorted(all_cores)[:threads]))
        yield threads if all_cores is not None else None
    finally:
        if all_cores is not None:
            _set_cores(all_cores)
        if before is None:
            del os.environ["MAGIC_THREADS"]
        else:
            os.environ["MAGIC_THREADS"] = before


def _set_cores(cores: set[int]) -> None:
    """For every thread of this process: libraries have started some already; some end meanwhile."""
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):
            os.sched_setaffinity(int(task.name), cores)


def measure(source: FrameSource, config: AgentConfig, model: DescriptorModel) -> AgentSpeed:
    """Run one recording through a whole agent, as fast as it goes."""
    _warm(source, config, model)
    speed = AgentSpeed()
    slam = _slam(source, config, model)
    with ThreadPoolExecutor(1, "read") as reading, ThreadPoolExecutor(1, "encode") as encoding:
        encoded: list[Future[float]] = []
        started, cpu_started = time.perf_counter(), time.process_time()

        def close(submap: Submap | None) -> None:
            if submap is not None:
                encoded.append(encoding.submit(_encode, submap, model, config.places_keyframes))
                speed.submap_ends_s.append(time.perf_counter() - started)
                speed.submap_frames.append(len(submap.trajectory))

        for frame, waited_s in _read_ahead(source, reading, config.queue_frames):
            speed.waiting_s += waited_s
            result = slam.process(frame)
            _count(speed, result)
            close(result.finished)
        close(slam.finish())
        speed.encoding_s = sum(future.result() for future in encoded)
        speed.wall_s = time.perf_counter() - started
        speed.cpu_s = time.process_time() - cpu_started
    speed.submaps = len(encoded)
    return speed


def _count(speed: AgentSpeed, result: FrameResult) -> None:
    speed.frames += 1
    speed.lost_frames += result.lost
    speed.keyframes += result.is_keyframe
    speed.tracking_ms.append(result.tracking_ms)
    speed.mapping_ms.append(result.mapping_ms)


def _read_ahead(
    source: FrameSource, executor: ThreadPoolExecutor, count: int
) -> Iterator[tuple[Frame, float]]:
    """(frame, seconds that it was waited for), with `count` frames on their way."""
    coming: deque[Future[Frame]] = deque()
    for number in range(len(source) + count):
        if number < len(source):
            coming.append(executor.submit(source.__getitem__, number))
        if number >= count:
            began = time.perf_counter()
            yield coming.popleft().result(), time.perf_counter() - began


def _encode(submap: Submap, model: DescriptorModel, keyframes: int) -> float:
    """Keyframes described and both encodings made, as the uplink does it; returns the seconds."""
    began = time.perf_counter()
    submap = with_described_keyframes(submap, model.describe, count=keyframes)
    encode_submap(submap, request_id=submap.name)
    encode_submap(submap, request_id=submap.name, encoding=SubmapEncoding.lossless())
    return time.perf_counter() - began


def _slam(source: FrameSource, config: AgentConfig, model: DescriptorModel) -> LocalSlam:
    return LocalSlam(
        source.camera, config, session="bench", agent=source.name, describe=model.describe
    )


def _warm(source: FrameSource, config: AgentConfig, model: DescriptorModel) -> None:
    """A few frames beforehand, so that no library loads while time is taken."""
    slam = _slam(source, config, model)
    for number in range(min(_WARM_FRAMES, len(source))):
        slam.process(source[number])
    last = slam.finish()
    if last is not None:
        _encode(last, model, config.places_keyframes)
