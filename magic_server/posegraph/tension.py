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

MANY = 10
"""To count up all vertices is faster than to go to every ninth."""


class Tension:
    """The gradient of half the squared Mahalanobis norms, by vertex; tangents are ours."""

    def __init__(self) -> None:
        self.edges = EdgeRows()
        self._pull = Rows((2, 6))
        """What each edge adds to the gradient at its source and at its target."""
        self._squared = Rows(())
        self._linearised = Rows((6,))
        """Residuals that matrices were last made at."""
        self._gradient, self._forgotten = Rows((6,)), Rows((6,))
        """Now, and when it was last forgotten what is fresh of it."""

    def __len__(self) -> int:
        return len(self.edges)

    def add_vertices(self, count: int) -> None:
        """More vertices, which nothing pulls at."""
        self._gradient.extend(np.zeros((count, 6)))
        self._forgotten.extend(np.zeros((count, 6)))

    def add(self, edges: EdgeArrays) -> None:
        """More edges; they pull once they are refreshed."""
        self.edges.add(edges)
        self._pull.extend(np.zeros((len(edges), 2, 6)))
        self._squared.extend(np.zeros(len(edges)))
        self._linearised.extend(np.zeros((len(edges), 6)))

    def release(self, number: int) -> None:
        """An edge that pulls no more, and is not to be refreshed again."""
        index = np.array([number])
        self._pulled(self.edges.some(index), index, np.zeros((1, 2, 6)))
        self._squared.view[number] = 0.0

    def refresh(self, numbers: Numbers, poses: Array) -> tuple[Array, Array]:
        """Edges whose poses changed pull anew.

        Returns their squared Mahalanobis norms (k,), and how far their residuals (m, rad) are from
        those that their matrices were made at (k,).
        """
        edges = self.edges.some(numbers)
        target_from_source, residuals = _misfit(edges, poses)
        forces = np.einsum("nij,nj->ni", edges.information, residuals)
        self._pulled(edges, numbers, _pull(residuals, forces, target_from_source))
        squared = np.einsum("ni,ni->n", residuals, forces)
        self._squared.view[numbers] = squared
        return squared, np.abs(residuals - self._linearised.view[numbers]).max(axis=1, initial=0.0)

    def blocks(self, numbers: Numbers, poses: Array) -> Blocks:
        """Second derivatives of edges at the present poses."""
        edges = self.edges.some(numbers)
        target_from_source, residuals = _misfit(edges, poses)
        self._linearised.view[numbers] = residuals
        curl = _curl(residuals)
        target = np.eye(6) + 0.5 * curl + curl @ curl / 12.0
        source = -target @ stacked.adjoint(target_from_source)
        weighted = source.swapaxes(1, 2) @ edges.information
        return Blocks(
            edges.source,
            edges.target,
            source_source=weighted @ source,
            source_target=weighted @ target,
            target_target=target.swapaxes(1, 2) @ edges.information @ target,
        )

    @property
    def cost(self) -> float:
        """Half the squared Mahalanobis norms of all edges, as they were refreshed."""
        return 0.5 * float(self._squared.view.sum())

    @property
    def gradient(self) -> Array:
        """(n, 6)."""
        return self._gradient.view

    @property
    def fresh(self) -> tuple[Numbers, Array]:
        """The part of the gradient that came since it was last forgotten: (k,) vertices, (n, 6).

        Each edge is in it with both ends, so that it adds up to no force and no moment. A step that
        answers it leaves in it what the step missed, once edges are refreshed.
        """
        fresh = self._gradient.view - self._forgotten.view
        return np.flatnonzero(fresh.any(axis=1)), fresh

    def forget_fresh(self) -> None:
        """What is left of it is small, or a step answers the whole gradient."""
        self._forgotten.view[:] = self._gradient.view

    def _pulled(self, edges: EdgeArrays, numbers: Numbers, pull: Array) -> None:
        change = pull - self._pull.view[numbers]
        self._pull.view[numbers] = pull
        for end, vertices in enumerate((edges.source, edges.target)):
            _add_at(self._gradient.view, vertices, change[:, end])


def _add_at(rows: Array, index: Numbers, added: Array) -> None:
    """Add (k, 6) to rows (n, 6), several to some."""
    if MANY * len(index) < len(rows):
        np.add.at(rows, index, added)
        return
    for axis in range(rows.shape[1]):
        rows[:, axis] += np.bincount(index, weights=added[:, axis], minlength=len(rows))


def _misfit(edges: EdgeArrays, poses: Array) -> tuple[Array, Array]:
    """target_from_source (m, 4, 4) as the poses say, and the residuals (m, 6)."""
    source_from_target = stacked.inverse(poses[edges.source]) @ poses[edges.target]
    missed = stacked.inverse(edges.source_from_target) @ source_from_target
    return stacked.inverse(source_from_target), stacked.log(missed)


def _curl(residuals: Array) -> Array:
    """(m, 6, 6): with it, the inverse right Jacobian of SE(3) is I + C / 2 + C^2 / 12 + ..."""
    curl = np.zeros((len(residuals), 6, 6))
    curl[:, :3, :3] = curl[:, 3:, 3:] = stacked.cross_matrices(residuals[:, 3:])
    curl[:, :3, 3:] = stacked.cross_matrices(residuals[:, :3])
    return curl


def _pull(residuals: Array, forces: Array, target_from_source: Array) -> Array:
    """(m, 2, 6): forces carried to right perturbations of the sources and of the targets.

    The transposed Jacobians of `blocks`, without their matrices.
    """
    once = _curled(residuals, forces)
    at_target = forces + 0.5 * once + _curled(residuals, once) / 12.0
    push, twist = at_target[:, :3], at_target[:, 3:]
    source_from_target = target_from_source[:, :3, :3].swapaxes(1, 2)
    twist = twist - np.cross(target_from_source[:, :3, 3], push)
    pair = np.stack([push, twist], axis=2)  # (m, 3, 2)
    at_source = -(source_from_target @ pair).swapaxes(1, 2).reshape(-1, 6)
    return np.stack([at_source, at_target], axis=1)


def _curled(residuals: Array, forces: Array) -> Array:
    """The transposed curl times forces (m, 6)."""
    rho, phi = residuals[:, :3], residuals[:, 3:]
    push, twist = forces[:, :3], forces[:, 3:]
    return np.concatenate([np.cross(push, phi), np.cross(push, rho) + np.cross(twist, phi)], axis=1)
