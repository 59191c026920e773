"""The pose graph: sub-maps, tracked and recognised relations, robust optimisation, g2o files.

`magic_server.posegraph.solve.solve` solves it; that module loads the solver, which takes seconds.
"""

from magic_server.posegraph.problem import (
    Edge,
    PoseGraphConfig,
    PoseGraphProblem,
    PoseGraphSolution,
)

__all__ = ["Edge", "PoseGraphConfig", "PoseGraphProblem", "PoseGraphSolution"]
