"""Real frames beside what the merged map shows from the same, corrected pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core.data import Frame, FrameSource
from magic_core.errors import NotFound
from magic_core.evaluation.accuracy import main_component_trajectories
from magic_core.evaluation.image_metrics import depth_l1, ms_ssim, psnr, ssim
from magic_core.evaluation.run_folder import RunFolder
from magic_core.evaluation.trajectory import Trajectory
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera

ViewKind = Literal["train", "novel"]
VIEW_KINDS: tuple[ViewKind, ...] = ("train", "novel")
_SAME_TIME_S = 1e-3


class Perceptual(Protocol):
    """A perceptual distance of two (h, w, 3) images, such as Lpips."""

    def __call__(self, rendered: NDArray, reference: NDArray) -> float: ...


class View(Protocol):
    """What a rasteriser returns."""

    @property
    def colour(self) -> NDArray[np.float32]: ...
    @property
    def alpha(self) -> NDArray[np.float32]: ...
    @property
    def visible(self) -> NDArray[np.bool_]: ...
    @property
    def expected_depth(self) -> NDArray[np.float32]: ...


class Renders(Protocol):
    """What evaluation needs of a rasteriser."""

    def render(self, cloud: GaussianCloud, camera: Camera, world_from_camera: NDArray) -> View: ...


@dataclass(frozen=True, slots=True)
class ChosenView:
    """A frame to compare, and where the run says it was taken."""

    kind: ViewKind
    """train: its image was used for mapping; novel: it never was."""
    source: FrameSource
    index: int
    world_from_camera: NDArray[np.float64]  # (4, 4) corrected, in the map's frame


@dataclass(frozen=True, slots=True)
class ComparedView:
    """A real frame, the rendered one, and how far they are apart."""

    chosen: ChosenView
    frame: Frame
    colour: NDArray[np.uint8]  # (h, w, 3) rendered
    depth: NDArray[np.float32]  # (h, w) rendered expected depth, metres
    psnr_db: float
    ssim: float
    ms_ssim: float
    """NaN for images with a side below 161 pixels."""
    lpips: float
    """NaN without the metric's weights."""
    depth_l1_m: float


def choose_views(
    run: RunFolder, sources: Sequence[FrameSource], *, per_kind: int
) -> list[ChosenView]:
    """At most `per_kind` views of each kind, spread evenly over agents and time."""
    candidates: dict[ViewKind, list[ChosenView]] = {kind: [] for kind in VIEW_KINDS}
    trajectories = main_component_trajectories(run)
    for source in sources:
        if source.name in trajectories:
            for view in _views_of(run, source, trajectories[source.name]):
                candidates[view.kind].append(view)
    chosen: list[ChosenView] = []
    for views in candidates.values():
        count = min(per_kind, len(views))
        chosen += [views[int((k + 0.5) * len(views) / count)] for k in range(count)]
    return chosen


def compare_views(
    views: Sequence[ChosenView],
    cloud: GaussianCloud,
    rasteriser: Renders,
    *,
    perceptual: Perceptual | None = None,
) -> Iterator[ComparedView]:
    """Render the map at each view and compare it with the real frame."""
    for view in views:
        frame = view.source[view.index]
        rendered = rasteriser.render(cloud, view.source.camera, view.world_from_camera)
        shown = np.clip(rendered.colour, 0.0, 1.0)
        real = frame.colour.astype(np.float32) / 255.0
        yield ComparedView(
            chosen=view,
            frame=frame,
            colour=np.rint(255.0 * shown).astype(np.uint8),
            depth=rendered.expected_depth,
            psnr_db=psnr(shown, real),
            ssim=ssim(shown, real),
            ms_ssim=ms_ssim(shown, real),
            lpips=float("nan") if perceptual is None else perceptual(shown, real),
            depth_l1_m=depth_l1(rendered.expected_depth, frame.depth, alpha=rendered.alpha),
        )


def _views_of(run: RunFolder, source: FrameSource, trajectory: Trajectory) -> Iterator[ChosenView]:
    """Every frame of a source that has a corrected pose."""
    try:
        keyframes = set(run.read_agent_report(source.name).keyframes)
    except NotFound:  # a killed agent left no report: nobody knows which frames it mapped
        return
    for index, time in enumerate(_times(source)):
        nearest = int(np.searchsorted(trajectory.timestamps_s, time - _SAME_TIME_S))
        if nearest < len(trajectory) and abs(trajectory.timestamps_s[nearest] - time) < (
            _SAME_TIME_S
        ):
            kind: ViewKind = "train" if index in keyframes else "novel"
            yield ChosenView(kind, source, index, trajectory.world_from_camera[nearest])


def _times(source: FrameSource) -> list[float]:
    timed_poses = getattr(source, "timed_poses", None)
    if timed_poses is not None:
        return [time for time, _ in timed_poses()]
    return [frame.timestamp_s for frame in source]
