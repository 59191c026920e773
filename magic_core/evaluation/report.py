"""`report.html`: one file that shows how a run went, and `overview.png`, its picture."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import cv2
import jinja2
import numpy as np
from numpy.typing import NDArray

from magic_core.data import FrameSource
from magic_core.errors import NotFound
from magic_core.evaluation import charts
from magic_core.evaluation.accuracy import main_component_trajectories, measure_trajectories
from magic_core.evaluation.evaluate import default_rasteriser
from magic_core.evaluation.overview import overview_picture
from magic_core.evaluation.records import AgentReport, LoopRecord, agent_of, index_of
from magic_core.evaluation.run_folder import RunFolder
from magic_core.evaluation.trajectory import Trajectory
from magic_core.evaluation.vantage import plan_frame
from magic_core.evaluation.views import ComparedView, Renders, choose_views, compare_views
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import se3

_TEMPLATE = "report.html.j2"
_JPEG_QUALITY = 88


@dataclass(frozen=True, slots=True)
class AgentRow:
    """One agent in the report's table."""

    name: str
    colour: str
    report: AgentReport | None
    ate_m: float | None
    ate_tracked_m: float | None
    path_m: float | None


def write_report(
    run: RunFolder,
    *,
    sources: Sequence[FrameSource],
    cloud: GaussianCloud | None = None,
    rasteriser: Renders | None = None,
    views_per_kind: int = 4,
) -> None:
    """Write `report.html` (self-contained) and, where there is a map, `overview.png`.

    Sections whose data a run lacks are left out: a run that was cut short has a report too.
    """
    rasteriser = rasteriser or default_rasteriser()
    if cloud is None and run.map_path.is_file():
        cloud = run.read_map()
    views: list[ComparedView] = []
    if cloud is not None:
        chosen = choose_views(run, sources, per_kind=views_per_kind)
        views = list(compare_views(chosen, cloud, rasteriser))
    trajectories = main_component_trajectories(run)
    overview = None
    if cloud is not None and len(cloud) and trajectories and sources:
        new_views = [view for view in views if view.chosen.kind == "novel"]
        overview = overview_picture(
            cloud, sources[0].camera, trajectories, rasteriser, new_views=new_views
        )
        run.overview_path.write_bytes(overview)
    run.report_path.write_text(_page(run, views, overview), encoding="utf-8")


def _page(run: RunFolder, views: Sequence[ComparedView], overview: bytes | None) -> str:
    loops = run.read_loops() if run.loops_path.is_file() else []
    reports = [report for agent in run.agents() if (report := _agent_report(run, agent))]
    timed = [report for report in reports if report.tracking_ms]
    config = run.config_path.read_text() if run.config_path.is_file() else ""
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"cm": _centimetres, "number": _number, "short": _short_name}
    template = resources.files("magic_core.evaluation").joinpath(_TEMPLATE).read_text("utf-8")
    return environment.from_string(template).render(
        name=run.path.resolve().name,
        metrics=_Metrics(run.read_metrics() if run.metrics_path.is_file() else {}),
        overview=_data_url(overview, "png") if overview else None,
        trajectories=_trajectories(run, loops),
        views=[_view_row(view) for view in views],
        loops=sorted(loops, key=lambda loop: (not loop.accepted, -loop.similarity)),
        agents=_agent_rows(run),
        timing=_data_url(charts.timing_chart(timed), "png") if timed else None,
        config=config,
    )


class _Metrics:
    """Dotted access to metrics.json that gives None for what a run did not measure."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values

    def __call__(self, path: str) -> Any:
        value: Any = self._values
        for key in path.split("."):
            if not isinstance(value, Mapping) or key not in value:
                return None
            value = value[key]
        return value


def _trajectories(run: RunFolder, loops: Sequence[LoopRecord]) -> str | None:
    after = main_component_trajectories(run)
    if not after:
        return None
    accuracy = measure_trajectories(run)
    before, truth = {}, {}
    for agent, corrected in after.items():
        if run.has_trajectory(agent, "tracked"):
            before[agent] = _started_at(run.read_trajectory(agent, "tracked"), corrected)
        if accuracy.truth_from_world is not None and run.has_trajectory(agent, "ground_truth"):
            known = run.read_trajectory(agent, "ground_truth")
            truth[agent] = known.transformed(se3.inverse(accuracy.truth_from_world))
    anchors = _anchors(run)
    chart = charts.trajectory_chart(
        before, after, truth,
        frame=plan_frame(list(after.values())),
        loops=loops,
        anchors_before=_anchors_on_tracks(run, before),
        anchors_after=anchors,
    )  # fmt: skip
    return _data_url(chart, "png")


def _started_at(tracked: Trajectory, corrected: Trajectory) -> Trajectory:
    """Odometry laid at the corrected pose of its first frame: both start together."""
    first = corrected.timestamps_s[0]
    begin = int(np.abs(tracked.timestamps_s - first).argmin())
    world_from_odometry = corrected.world_from_camera[0] @ se3.inverse(
        tracked.world_from_camera[begin]
    )
    return tracked.transformed(world_from_odometry)


def _anchors(run: RunFolder) -> dict[str, NDArray[np.float64]]:
    """Corrected anchor positions of the largest component."""
    if not run.components_path.is_file():
        return {}
    components = run.read_components()
    main = components.largest()
    return {
        name: anchor.world_from_anchor[:3, 3]
        for name, anchor in components.anchors.items()
        if anchor.component == main
    }


def _anchors_on_tracks(
    run: RunFolder, tracks: Mapping[str, Trajectory]
) -> dict[str, NDArray[np.float64]]:
    """The same anchors where odometry alone puts them."""
    places = {}
    for name in _anchors(run):
        agent = agent_of(name)
        report = _agent_report(run, agent)
        if report is None or agent not in tracks:
            continue
        starts = report.submap_first_frames
        if index_of(name) < len(starts):
            frame = min(starts[index_of(name)] - starts[0], len(tracks[agent]) - 1)
            places[name] = tracks[agent].positions[frame]
    return places


def _agent_rows(run: RunFolder) -> list[AgentRow]:
    accuracy = measure_trajectories(run)
    rows = []
    for number, agent in enumerate(run.agents()):
        path = None
        if run.has_trajectory(agent, "corrected"):
            path = run.read_trajectory(agent, "corrected").path_length_m
        rows.append(
            AgentRow(
                name=agent,
                colour=charts.colour_of(number),
                report=_agent_report(run, agent),
                ate_m=accuracy.corrected_m.get(agent),
                ate_tracked_m=accuracy.tracked_m.get(agent),
                path_m=path,
            )
        )
    return rows


def _agent_report(run: RunFolder, agent: str) -> AgentReport | None:
    try:
        return run.read_agent_report(agent)
    except NotFound:  # the agent was killed before it could write one
        return None


def _view_row(view: ComparedView) -> dict[str, Any]:
    known = view.frame.depth[view.frame.depth > 0]
    near, far = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    return {
        "kind": view.chosen.kind,
        "agent": view.chosen.source.name,
        "index": view.chosen.index,
        "psnr_db": view.psnr_db,
        "ssim": view.ssim,
        "depth_l1_m": view.depth_l1_m,
        "real": _jpeg_url(view.frame.colour),
        "rendered": _jpeg_url(view.colour),
        "real_depth": _jpeg_url(coloured_depth(view.frame.depth, near=near, far=far)),
        "rendered_depth": _jpeg_url(coloured_depth(view.depth, near=near, far=far)),
    }


def coloured_depth(depth: NDArray[np.float32], *, near: float, far: float) -> NDArray[np.uint8]:
    """(h, w, 3) RGB of a depth image: turbo from near (red) to far (blue), black = no reading."""
    share = np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
    bgr = cv2.applyColorMap(np.rint(255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)
    rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    return np.where((depth > 0)[..., None], rgb, 0).astype(np.uint8)


def _jpeg_url(rgb: NDArray[np.uint8]) -> str:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return _data_url(encoded.tobytes(), "jpeg")


def _data_url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _centimetres(metres: float | None) -> str:
    return "–" if metres is None or not np.isfinite(metres) else f"{100 * metres:.2f} cm"


def _number(value: float | None, digits: int = 2, unit: str = "") -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    return f"{value:,.{digits}f}{unit}"


def _short_name(submap: str) -> str:
    return f"{agent_of(submap)} · {index_of(submap)}"
