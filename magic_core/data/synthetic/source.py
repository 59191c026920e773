"""The synthetic flat as frame sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from functools import lru_cache
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from magic_core.data.frame import Frame, FrameSource
from magic_core.data.synthetic.config import Detail, SyntheticConfig
from magic_core.data.synthetic.flat import build_flat
from magic_core.data.synthetic.lighting import LightingConfig, bake
from magic_core.data.synthetic.materials import make_materials
from magic_core.data.synthetic.mesh import MeshBuilder
from magic_core.data.synthetic.noise import kinect_depth
from magic_core.data.synthetic.paths import walk_poses
from magic_core.data.synthetic.renderer import MeshRenderer
from magic_core.errors import ConfigError


class SyntheticSource:
    """One agent's walk; frames are rendered when asked for, the same ones every time."""

    def __init__(
        self, config: SyntheticConfig, agent: int, *, scale: float = 1.0, numbers: Sequence[int]
    ) -> None:
        self.name = f"agent_{agent}"
        self.camera = config.camera.scaled(scale)
        self._config = config
        self._agent = agent
        self._numbers = tuple(numbers)
        rng = np.random.default_rng((config.seed, 1, agent))
        self._poses = walk_poses(agent, config.frames, rng=rng)

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def timed_poses(self) -> list[tuple[float, NDArray[np.float64] | None]]:
        """(timestamp, ground truth) of every frame, without rendering any."""
        return [(number / self._config.rate_hz, self._poses[number]) for number in self._numbers]

    def __getitem__(self, index: int) -> Frame:
        position = range(len(self._numbers))[index]
        number = self._numbers[position]
        config, pose = self._config, self._poses[number]
        picture = flat_renderer(config.seed, config.detail).render(self.camera, pose)
        depth = picture.depth
        if config.depth_noise:
            rng = np.random.default_rng((config.seed, 2, self._agent, number))
            depth = kinect_depth(depth, picture.cosine, rng=rng)
        return Frame(position, number / config.rate_hz, picture.colour, depth, pose.copy())


def synthetic_flat(
    config: SyntheticConfig | None = None,
    *,
    scale: float = 1.0,
    max_frames: int | None = None,
    stride: int = 1,
) -> list[FrameSource]:
    """One source per agent of the synthetic flat."""
    config = config or SyntheticConfig()
    config.validate()
    numbers = range(config.frames)[::stride][:max_frames]
    return [
        SyntheticSource(config, agent, scale=scale, numbers=numbers)
        for agent in range(config.agents)
    ]


def open_synthetic(
    address: str, *, scale: float = 1.0, max_frames: int | None = None, stride: int = 1
) -> list[FrameSource]:
    """The sources of an address such as `synthetic://flat?agents=3&frames=120&seed=1`."""
    parts = urlsplit(address)
    scene = (parts.netloc or parts.path).strip("/")
    if scene != "flat":
        raise ConfigError.field("dataset", f"{address}: the only synthetic scene is `flat`")
    config = _config_from_query(dict(parse_qsl(parts.query)))
    return synthetic_flat(config, scale=scale, max_frames=max_frames, stride=stride)


def _config_from_query(query: dict[str, str]) -> SyntheticConfig:
    kinds = {field.name: type(field.default) for field in fields(SyntheticConfig)}
    values = {}
    for name, text in query.items():
        if name not in kinds:
            raise ConfigError.field(name, f"unknown setting; expected one of {', '.join(kinds)}")
        try:
            values[name] = _parse(text, kinds[name])
        except ValueError as error:
            raise ConfigError.field(name, f"{text!r}: expected {kinds[name].__name__}") from error
    return SyntheticConfig(**values)


def _parse(text: str, kind: type) -> object:
    if kind is bool:
        if text.lower() not in ("true", "false", "1", "0", "yes", "no"):
            raise ValueError(text)
        return text.lower() in ("true", "1", "yes")
    return kind(text)


@lru_cache(maxsize=2)
def flat_renderer(seed: int, detail: Detail) -> MeshRenderer:
    """The lit flat; built once per process, seed and detail."""
    rng = np.random.default_rng((seed, 0))
    builder = MeshBuilder(spacing_m=0.13 if detail == "full" else 0.4)
    lamps = build_flat(builder, make_materials(rng), rng)
    mesh = builder.mesh()
    caster = _caster(mesh.vertices, mesh.triangles)
    config = LightingConfig()
    if detail == "draft":
        config = LightingConfig(directions=24, lamp_samples=2, bounces=2)
    light = bake(mesh, caster, lamps, config=config, rng=rng)
    return MeshRenderer(mesh, light, caster)


def _caster(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32]
) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(vertices),
        o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)),
    )
    return scene
