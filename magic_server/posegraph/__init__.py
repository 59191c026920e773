"""The pose graph: sub-maps, tracked and recognised relations, robust optimisation, g2o files."""

from magic_server.posegraph.problem import (
    Edge,
    PoseGraphConfig,
    PoseGraphProblem,
    PoseGraphSolution,
)
from magic_server.posegraph.solve import solve

__all__ = ["Edge", "PoseGraphConfig", "PoseGraphProblem", "PoseGraphSolution", "solve"]
