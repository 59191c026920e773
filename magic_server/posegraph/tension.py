"""Edges that pull at poses: the gradient of their error, kept exact while few of them change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.fronts import Blocks
from magic_server.posegraph.growing import EdgeRows, Rows

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


class Tension:
    """The gradient of half the squared Mahalanobis norms, by vertex; tangents are ours."""

    def __init__(self) -> None:
        self.edges = EdgeRows()
        self._pull = Rows((2, 6))
        """What each edge adds to the gradient at its source and at its target."""
        self._linearised = Rows((6,))
        """Residuals that matrices were last made at."""
        self._gradient = Rows((6,))
        self._fresh: dict[int, Array] = {}

    def __len__(self) -> int:
        return len(self.edges)

    def add_vertices(self, count: int) -> None:
        """More vertices, which nothing pulls at."""
        self._gradient.extend(np.zeros((count, 6)))

    def add(self, edges: EdgeArrays) -> None:
        """More edges; they pull once they are refreshed."""
        self.edges.add(edges)
        self._pull.extend(np.zeros((len(edges), 2, 6)))
        self._linearised.extend(np.zeros((len(edges), 6)))

    def release(self, number: int) -> None:
        """An edge that pulls no more, and is not to be refreshed again."""
        edge = self.edges.some([number])
        self._pulled(edge, np.array([number]), np.zeros((1, 2, 6)), fresh=True)

    def refresh(self, numbers: Numbers, poses: Array, *, fresh: bool) -> tuple[Array, Array]:
        """Edges whose poses changed pull anew; `fresh` counts the change as fresh.

        Returns their squared Mahalanobis norms (k,), and how far their residuals (m, rad) are from
        those that their matrices were made at (k,).
        """
        edges = self.edges.some(numbers)
        residuals = edges.residuals(poses)
        forces = np.einsum("nij,nj->ni", edges.information, residuals)
        source, target = _jacobians(edges, residuals, poses)
        pull = np.stack([np.einsum("nji,nj->ni", one, forces) for one in (source, target)], axis=1)
        self._pulled(edges, numbers, pull, fresh=fresh)
        squared = np.einsum("ni,ni->n", residuals, forces)
        return squared, np.abs(residuals - self._linearised.view[numbers]).max(axis=1, initial=0.0)

    def blocks(self, numbers: Numbers, poses: Array) -> Blocks:
        """Second derivatives of edges at the present poses."""
        edges = self.edges.some(numbers)
        residuals = edges.residuals(poses)
        self._linearised.view[numbers] = residuals
        source, target = _jacobians(edges, residuals, poses)
        weighted = source.swapaxes(1, 2) @ edges.information
        return Blocks(
            edges.source,
            edges.target,
            source_source=weighted @ source,
            source_target=weighted @ target,
            target_target=target.swapaxes(1, 2) @ edges.information @ target,
        )

    @property
    def gradient(self) -> Array:
        """(n, 6)."""
        return self._gradient.view

    @property
    def fresh(self) -> dict[int, Array]:
        """The part of the gradient (6,) by vertex that came since it was last forgotten.

        Each edge is in it with both ends, so that it adds up to no force and no moment. A step that
        answers it, and is refreshed as fresh too, leaves in it what the step missed.
        """
        return self._fresh

    def forget_fresh(self) -> None:
        """What is left of it is small, or a step is going to answer the whole gradient."""
        self._fresh = {}

    def _pulled(self, edges: EdgeArrays, numbers: Numbers, pull: Array, *, fresh: bool) -> None:
        change = pull - self._pull.view[numbers]
        self._pull.view[numbers] = pull
        for end, vertices in enumerate((edges.source, edges.target)):
            np.add.at(self._gradient.view, vertices, change[:, end])
            for vertex, force in zip(vertices.tolist(), change[:, end], strict=True):
                if not fresh:
                    break
                self._fresh[vertex] = self._fresh.get(vertex, 0.0) + force


def _jacobians(edges: EdgeArrays, residuals: Array, poses: Array) -> tuple[Array, Array]:
    """(m, 6, 6) derivatives of residuals by right perturbations of the sources and the targets."""
    # The inverse right Jacobian of SE(3) up to the second power of the residual.
    curl = np.zeros((len(residuals), 6, 6))
    curl[:, :3, :3] = curl[:, 3:, 3:] = stacked.cross_matrices(residuals[:, 3:])
    curl[:, :3, 3:] = stacked.cross_matrices(residuals[:, :3])
    target = np.eye(6) + 0.5 * curl + curl @ curl / 12.0
    target_from_source = stacked.inverse(poses[edges.target]) @ poses[edges.source]
    return -target @ stacked.adjoint(target_from_source), target
