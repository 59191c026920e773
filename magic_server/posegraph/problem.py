"""What a pose graph is made of, how it is to be solved, and what comes out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import ConfigError, FieldViolation, InvalidInput

Pose = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured relation of two vertices."""

    source: str
    target: str
    source_from_target: Pose
    """(4, 4): maps points in the target's anchor frame to the source's."""
    information: NDArray[np.float64]
    """(6, 6), tangent order (translation, rotation), right perturbation; 1/m^2, 1/rad^2."""


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """How a pose graph is solved."""

    robust: Literal["none", "gnc"] = "gnc"
    """`gnc` finds and leaves out wrong loops, `none` trusts every edge."""
    inlier_probability: float = 0.999
    """A right loop's squared Mahalanobis norm is below the chi-square quantile of this."""
    odometry_floor_m: float = 0.01
    """Added to the tracker's standard deviation per edge: its own is optimistic."""
    odometry_floor_rad: float = 0.005
    """The same for rotation."""
    odometry_floor_share: float = 0.01
    """Added per metre and per radian of motion along the edge: drift grows with motion."""
    max_unsupported_correction_m: float = 0.5
    """A loop inside one odometry chain that moves its ends by more than this, beyond what the
    odometry's own uncertainty explains, needs a second consistent loop before it counts."""
    max_iterations: int = 100
    """Levenberg-Marquardt iterations of the final solve."""
    hierarchy: Literal["auto", "on", "off"] = "auto"
    """Condense regions of the graph onto the separators between them, so that a new sub-map costs
    what its neighbourhood costs: `auto` does so from `hierarchy_from` sub-maps on."""
    hierarchy_from: int = 10_000
    """How large a graph must be for `hierarchy` `auto`; smaller ones are solved as a whole."""

    def is_hierarchical(self, count: int) -> bool:
        """Whether a graph of so many sub-maps is condensed by regions."""
        return self.hierarchy == "on" or (self.hierarchy == "auto" and count >= self.hierarchy_from)

    @property
    def squared_norm_limit(self) -> float:
        """The bound on squared Mahalanobis norms that `inlier_probability` stands for."""
        from scipy.special import gammaincinv

        # The chi-square quantile with 6 degrees of freedom; scipy.stats loads for seconds.
        return float(2.0 * gammaincinv(3.0, self.inlier_probability))

    def __post_init__(self) -> None:
        if self.robust not in ("none", "gnc"):
            raise ConfigError.field("posegraph.robust", f"{self.robust!r}: expected none or gnc")
        if not 0.5 < self.inlier_probability < 1.0:
            raise ConfigError.field(
                "posegraph.inlier_probability", f"{self.inlier_probability}: expected 0.5 to 1"
            )
        for name in ("odometry_floor_m", "odometry_floor_rad", "odometry_floor_share"):
            if getattr(self, name) < 0:
                raise ConfigError.field(f"posegraph.{name}", "must not be negative")
        for name in ("max_iterations", "hierarchy_from"):
            if getattr(self, name) < 1:
                raise ConfigError.field(f"posegraph.{name}", "expected at least 1")
        if self.hierarchy not in ("auto", "on", "off"):
            raise ConfigError.field(
                "posegraph.hierarchy", f"{self.hierarchy!r}: expected auto, on or off"
            )


@dataclass(frozen=True, slots=True)
class PoseGraphProblem:
    """Sub-maps and their relations."""

    vertices: tuple[str, ...]
    """Oldest first: the first of each component fixes its frame and names it."""
    odometry: tuple[Edge, ...] = ()
    loops: tuple[Edge, ...] = ()
    priors: Mapping[str, Pose] = field(default_factory=dict)
    """Known `world_from_anchor` of some vertices, all in one world."""
    initial: Mapping[str, Pose] | None = None
    """An estimate to start from (an earlier solution); may cover some vertices only."""

    def validate(self) -> None:
        """Raise InvalidInput naming each broken rule."""
        known = set(self.vertices)
        found = []
        if len(known) != len(self.vertices):
            found.append(FieldViolation("vertices", "names must be unique"))
        for kind, edges in (("odometry", self.odometry), ("loops", self.loops)):
            for index, edge in enumerate(edges):
                where = f"{kind}[{index}]"
                found += [FieldViolation(where, text) for text in _edge_violations(edge, known)]
        found += [
            FieldViolation(f"priors[{name}]", "no such vertex")
            for name in self.priors
            if name not in known
        ]
        if found:
            message = f"{found[0].field}: {found[0].description}"
            raise InvalidInput(message, violations=tuple(found))


@dataclass(frozen=True, slots=True)
class PoseGraphSolution:
    """One pose for each vertex, and which loops it rests on."""

    world_from_anchor: dict[str, Pose]
    """In the frame of the vertex's component."""
    component: dict[str, str]
    """Of each vertex: the id of its component, which is the name of its oldest vertex."""
    kept: tuple[bool, ...]
    """Of each loop, in the problem's order."""
    error_before: float
    """Half the squared Mahalanobis norm of all kept edges at the start."""
    error_after: float
    """The same at the solution."""


def _edge_violations(edge: Edge, known: set[str]) -> list[str]:
    missing = [name for name in (edge.source, edge.target) if name not in known]
    if missing:
        return [f"no vertex {missing[0]!r}"]
    if edge.source == edge.target:
        return [f"joins {edge.source!r} with itself"]
    if edge.source_from_target.shape != (4, 4) or not np.isfinite(edge.source_from_target).all():
        return ["source_from_target must be a finite 4x4 matrix"]
    if edge.information.shape != (6, 6) or not np.isfinite(edge.information).all():
        return ["information must be a finite 6x6 matrix"]
    return []
