"""What the page shows, written to a Rerun recording (.rrd): a `Draw` of the feed like the page.

Everything is in the conventions of docs/conventions.md: metres, x right, y down, z forward (Rerun's
RDF). Every row has two times: the pose graph's `revision`, and `sensor_time` as the agents told it.
"""

from __future__ import annotations

import importlib
import importlib.util
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_cli.viewer.colours import RED, colour_of, loop_colour
from magic_cli.viewer.detail import keep_every, thinned
from magic_cli.viewer.model import Pose, SessionView, SubmapView
from magic_core.errors import ConfigError
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera, se3
from magic_core.wire import names
from magic_core.wire.records import LoopCandidate

_EPOCH_S = 1e8
"""Sensor times above are seconds since 1970; below, they count from a recording's start."""
_FRUSTUM_M = 0.12


def require_rerun(path: Path, *, overwrite: bool = False) -> None:
    """ConfigError where no recording can be begun at `path`: no package, or something is there."""
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError(
            "--rerun needs the package rerun-sdk (170 MB), which is not installed: "
            "pip install 'rerun-sdk>=0.41', or install magic-slam with its extra [rerun]"
        )
    if path.is_dir():
        raise ConfigError(f"--rerun {path}: a folder; expected a file to write, such as run.rrd")
    if path.exists() and not overwrite:
        raise ConfigError(f"--rerun {path}: exists; name another file, or remove this one")


class Recording:
    """Writes a session's growth to a file; `update` is called with each new state.

    Entities: `map/AGENT/INDEX` (a transform that corrections move) with its points and anchor,
    `agents/AGENT/camera` with pose and keyframe images, `trajectories/AGENT/corrected|tracked`,
    `loops/accepted|rejected`, `loops/verdicts` (text), `merged/NUMBER`.
    """

    def __init__(self, path: Path, *, max_points: int) -> None:
        """Begin a recording, in place of what is at `path`. ConfigError without the package."""
        require_rerun(path, overwrite=True)
        self._rerun = rerun = _package("rerun")
        self._max_points = max_points
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = rerun.RecordingStream("magic-slam")
        self._stream.save(path, default_blueprint=_blueprint())
        self._stream.log("/", rerun.ViewCoordinates.RDF, static=True)
        self._lock = threading.Lock()
        self._view: SessionView | None = None
        self._logged: set[str] = set()
        self._poses: dict[str, Pose] = {}
        self._merged: dict[str, GaussianCloud] = {}
        self._verdicts: dict[tuple[str, str], tuple[str, bool]] = {}
        self._revision = -1

    def update(self, view: SessionView) -> None:
        """Write what is new in a state."""
        with self._lock:
            self._update(view)

    def close(self) -> None:
        """Write each camera's every frame at its last corrected pose, and end the file."""
        with self._lock:
            if self._view is not None:
                anchors = self._view.world_from_anchor()
                for agent in self._view.agent_names():
                    self._play(self._view, agent, anchors)
            self._stream.flush()
            self._stream.disconnect()

    def _update(self, view: SessionView) -> None:
        if view.snapshot is None or not view.submaps:
            return
        self._view = view
        self._set_times(view)
        anchors = view.world_from_anchor()
        new = [view.submaps[name] for name in anchors if name not in self._logged]
        for submap in new:
            self._add(submap)
        self._move(anchors)
        for submap in new:
            self._add_keyframes(submap, anchors[submap.name])
        self._set_times(view)
        if new or view.snapshot.revision != self._revision:
            self._draw_paths(view, anchors)
        self._draw_loops(view, anchors, moved=view.snapshot.revision != self._revision)
        self._draw_merged(view)
        self._revision = view.snapshot.revision

    def _set_times(self, view: SessionView) -> None:
        assert view.snapshot is not None
        self._stream.set_time("revision", sequence=view.snapshot.revision)
        self._set_sensor_time(max(s.times_s[-1] for s in view.submaps.values()))

    def _set_sensor_time(self, time_s: float) -> None:
        if self._counts_from_1970:
            self._stream.set_time("sensor_time", timestamp=time_s)
        else:
            self._stream.set_time("sensor_time", duration=time_s)

    @property
    def _counts_from_1970(self) -> bool:
        """One kind of time for the whole recording, as Rerun demands: that of the first sub-map."""
        assert self._view is not None
        return next(iter(self._view.submaps.values())).times_s[0] > _EPOCH_S

    def _add(self, submap: SubmapView) -> None:
        node = _node("map", submap.agent, submap.index)
        step = keep_every(len(submap.cloud), self._max_points)
        self._stream.log(f"{node}/points", self._points(thinned(submap.cloud, step)))
        self._stream.log(f"{node}/anchor", self._pinhole(submap.camera, submap.agent))
        self._stream.log(
            _node("agents", submap.agent, "camera"), self._pinhole(submap.camera, submap.agent),
            static=True,
        )  # fmt: skip
        self._logged.add(submap.name)

    def _move(self, anchors: dict[str, Pose]) -> None:
        """One transform for each sub-map that a correction moved."""
        for name, pose in anchors.items():
            known = self._poses.get(name)
            if known is None or not np.array_equal(known, pose):
                _, agent, index = names.parse_submap(name)
                self._stream.log(_node("map", agent, index), self._transform(pose))
                self._poses[name] = pose

    def _add_keyframes(self, submap: SubmapView, world_from_anchor: Pose) -> None:
        node = _node("agents", submap.agent, "camera")
        for keyframe in submap.keyframes:
            self._set_sensor_time(keyframe.timestamp_s)
            pose = world_from_anchor @ keyframe.anchor_from_camera
            self._stream.log(node, self._transform(pose))
            image = self._rerun.Image(keyframe.colour).compress(jpeg_quality=85)
            self._stream.log(f"{node}/image", image)

    def _draw_paths(self, view: SessionView, anchors: dict[str, Pose]) -> None:
        tracked = view.tracked()
        for agent in view.agent_names():
            colour = colour_of(agent)
            dark = tuple(value // 2 for value in colour)
            for kind, poses, shade in (("corrected", anchors, colour), ("tracked", tracked, dark)):
                parts = view.world_from_cameras(agent, poses)
                if parts:
                    path = np.concatenate(parts)[:, :3, 3]
                    lines = self._rerun.LineStrips3D([path], colors=[shade])
                    self._stream.log(_node("trajectories", agent, kind), lines)

    def _draw_loops(self, view: SessionView, anchors: dict[str, Pose], *, moved: bool) -> None:
        loops = [c for c in view.loops if c.source in anchors and c.target in anchors]
        news = [c for c in loops if self._verdicts.get((c.source, c.target)) != _state(c)]
        if not news and not moved:
            return
        for verdict in ("ACCEPTED", "REJECTED"):
            some = [c for c in loops if c.verdict == verdict]
            strips = [[anchors[c.source][:3, 3], anchors[c.target][:3, 3]] for c in some]
            lines = self._rerun.LineStrips3D(
                strips, colors=[loop_colour(c) for c in some], show_labels=False,
                labels=[_sentence(c) for c in some],
            )  # fmt: skip
            self._stream.log(_node("loops", verdict.lower()), lines)
        for loop in news:
            self._verdicts[loop.source, loop.target] = _state(loop)
            if loop.verdict in ("ACCEPTED", "REJECTED"):
                text = self._rerun.TextLog(
                    _sentence(loop), level="WARN" if loop_colour(loop) == RED else "INFO"
                )
                self._stream.log("loops/verdicts", text)

    def _draw_merged(self, view: SessionView) -> None:
        for number, (component, cloud) in enumerate(view.merged.items()):
            if self._merged.get(component) is cloud:
                continue
            self._merged[component] = cloud
            kept = thinned(cloud, keep_every(len(cloud), self._max_points))
            node = _node("merged", number)
            self._stream.log(node, self._transform(view.component_offset(component)))
            self._stream.log(f"{node}/points", self._points(kept))

    def _play(self, view: SessionView, agent: str, anchors: dict[str, Pose]) -> None:
        parts = view.world_from_cameras(agent, anchors)
        if not parts or view.snapshot is None:
            return
        poses = np.concatenate(parts)
        times = [
            t for s in view.submaps.values() if s.agent == agent and s.name in anchors
            for t in s.times_s
        ]  # fmt: skip
        kind = {"timestamp" if self._counts_from_1970 else "duration": times}
        self._stream.send_columns(
            _node("agents", agent, "camera"),
            indexes=[self._rerun.TimeColumn("sensor_time", **kind)],
            columns=self._rerun.Transform3D.columns(
                translation=poses[:, :3, 3],
                quaternion=[_xyzw(pose) for pose in poses],
            ),
        )

    def _transform(self, pose: Pose) -> Any:
        return self._rerun.Transform3D(translation=pose[:3, 3], quaternion=_xyzw(pose))

    def _points(self, cloud: GaussianCloud) -> Any:
        """Gaussians as points, as large as their two larger axes."""
        radii = np.sqrt(np.sort(cloud.scales, axis=1)[:, 1:].prod(axis=1))
        return self._rerun.Points3D(cloud.means, colors=_bytes(cloud), radii=radii)

    def _pinhole(self, camera: Camera, agent: str) -> Any:
        return self._rerun.Pinhole(
            focal_length=(camera.fx, camera.fy),
            principal_point=(camera.cx, camera.cy),
            resolution=(camera.width, camera.height),
            camera_xyz=self._rerun.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM_M,
            color=colour_of(agent),
        )


def _package(name: str) -> Any:
    """A package of the optional extra, unknown to a type checker where it is not installed."""
    return importlib.import_module(name)


def _xyzw(pose: Pose) -> list[float]:
    """A pose's rotation in the order that Rerun wants."""
    return se3.quaternion_from_rotation(pose[:3, :3])[[1, 2, 3, 0]].tolist()


def _bytes(cloud: GaussianCloud) -> NDArray[np.uint8]:
    return (np.clip(cloud.colours, 0.0, 1.0) * 255.0).astype(np.uint8)


def _node(*parts: object) -> str:
    """An entity's path; agents may be called what Rerun must have escaped."""
    escape = _package("rerun").escape_entity_path_part
    escaped: Iterable[str] = (escape(str(part)) for part in parts)
    return "/".join(escaped)


def _state(loop: LoopCandidate) -> tuple[str, bool]:
    return loop.verdict, loop.kept


def _sentence(loop: LoopCandidate) -> str:
    ends = [f"{agent}/{index}" for _, agent, index in map(names.parse_submap,
                                                          (loop.source, loop.target))]  # fmt: skip
    used = ", set aside by the solver" if loop.verdict == "ACCEPTED" and not loop.kept else ""
    return (
        f"{ends[0]} - {ends[1]}: {loop.reason}{used} (similarity {loop.similarity:.2f}, overlap "
        f"{loop.overlap:.2f}, fitness {loop.fitness:.2f}, RMSE {1e3 * loop.rmse_m:.1f} mm)"
    )


def _blueprint() -> Any:
    """What Rerun's viewer shows at first: sub-maps and merged map, and the loops' verdicts."""
    rrb = _package("rerun.blueprint")
    lines = ["+ /trajectories/**", "+ /loops/**", "+ /agents/**"]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Tabs(
                rrb.Spatial3DView(name="sub-maps", contents=["+ /map/**", *lines]),
                rrb.Spatial3DView(name="merged map", contents=["+ /merged/**", *lines]),
            ),
            rrb.TextLogView(name="loops", contents="/loops/verdicts"),
            row_shares=[4, 1],
        )
    )
