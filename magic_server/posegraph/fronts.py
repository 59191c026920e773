"""Multifrontal elimination over a dissection: each region condensed onto its separators, once.

A node's front holds its own vertices and the separators above that it touches. Eliminating its own
leaves a dense condensed matrix on those separators, which the parent adds to its front. When edges
change, the nodes that hold them and those above are eliminated again; all others stay as they are.
Every vertex has six numbers, (translation, rotation), right perturbation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from magic_server.posegraph import stacked
from magic_server.posegraph.dissection import Dissection

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
_potrf, _trtrs = get_lapack_funcs(("potrf", "trtrs"), dtype=np.float64)
(_trsm,) = get_blas_funcs(("trsm",), dtype=np.float64)

DAMPING = 1e-6
"""Added to each diagonal: a vertex that no edge holds in some direction stays where it is."""
HELD = 1e12
"""Information that holds a vertex."""
LIKENESS = 0.002
"""Condensed matrices that differ by less, relative to their diagonals, do for a while."""
STRAIN_M = 3e-4
"""What lies below separators that bend by less moves as one rigid body."""
REACH = np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])
"""Metres that a rotation of one radian moves what is near."""


@dataclass(frozen=True, slots=True)
class Blocks:
    """Second derivatives of m edges, (m, 6, 6) each, between their sources and targets (m,)."""

    source: Numbers
    target: Numbers
    source_source: Array
    source_target: Array
    target_target: Array


@dataclass(frozen=True, slots=True)
class Front:
    """One eliminated node."""

    own: Numbers  # (p,) vertices
    above: Numbers  # (b,) vertices of the separators that it touches, ascending
    factor: Array  # (6p, 6p) lower triangular
    coupling: Array  # (6p, 6b) factor^-1 of the block between own and above
    condensed: Array  # (6b, 6b) what it says about the vertices above

    @property
    def nbytes(self) -> int:
        """Memory of its matrices."""
        return self.factor.nbytes + self.coupling.nbytes + self.condensed.nbytes


@dataclass(frozen=True, slots=True)
class Step:
    """How vertices move; those in neither part stay."""

    vertices: Numbers  # (k,) ascending
    tangents: Array  # (k, 6) of each
    rigid: tuple[tuple[Numbers, Array], ...]
    """Vertices that move by one motion (4, 4) of the world."""


class Fronts:
    """The eliminated nodes of a dissection."""

    def __init__(self, tree: Dissection) -> None:
        self._tree = tree
        self._fronts: dict[int, Front] = {}
        self._untold: dict[int, Array] = {}
        """The newest condensed matrices of nodes, where the parent goes on with older ones."""

    @property
    def nbytes(self) -> int:
        """Memory of all matrices."""
        return sum(front.nbytes for front in self._fronts.values())

    def eliminate(
        self,
        stale: Collection[int],
        blocks: Callable[[int], Blocks],
        held: set[int],
        *,
        exactly: bool,
    ) -> None:
        """Eliminate nodes again, `blocks` being the edges that lie in each, and those above them.

        Unless `exactly`, nodes above go on with what they were told about those below as long as
        that has changed little.
        """
        nodes = self._tree.nodes
        waiting = set(stale)
        if exactly:
            waiting.update(nodes[node].parent for node in self._untold)
            for node, condensed in self._untold.items():
                self._fronts[node] = replace(self._fronts[node], condensed=condensed)
            self._untold.clear()
        while waiting:
            node = max(waiting, key=lambda n: (nodes[n].depth, n))
            waiting.remove(node)
            before = self._fronts.get(node)
            front = self._eliminated(node, blocks(node), held)
            self._untold.pop(node, None)
            if not exactly and before is not None and _is_like(front, before):
                self._untold[node] = front.condensed
                front = replace(front, condensed=before.condensed)
            elif nodes[node].parent >= 0:
                waiting.add(nodes[node].parent)
            self._fronts[node] = front

    @property
    def is_exact(self) -> bool:
        """Whether every node knows the newest about those below it."""
        return not self._untold

    def step(self, gradient: Mapping[int, Array], poses: Array, held: set[int]) -> Step:
        """How all vertices move to where a gradient, (6,) by vertex, vanishes."""
        tree = self._tree
        holding = {node for vertex in held for node in tree.path(tree.node_of[vertex])}
        return self._backward(self._forward(gradient), poses, holding)

    def _forward(self, gradient: Mapping[int, Array]) -> dict[int, Array]:
        """Right-hand sides of the nodes that a gradient reaches, after elimination."""
        tree, result = self._tree, {}
        reached = {tree.node_of[vertex] for vertex in gradient}
        reached.update(*(tree.path(node) for node in tuple(reached)))
        passed: dict[int, list[tuple[Numbers, Array]]] = {}
        for node in sorted(reached, key=lambda n: (-tree.nodes[n].depth, n)):
            front = self._fronts[node]
            rhs = np.zeros((len(front.own) + len(front.above), 6))
            for row, vertex in enumerate(front.own.tolist()):
                if vertex in gradient:
                    rhs[row] = -gradient[vertex]
            for vertices, values in passed.pop(node, ()):
                rhs[_places(front, vertices)] += values
            own = 6 * len(front.own)
            flat = rhs.ravel()
            result[node] = solved = flat[:own]
            if own:
                result[node], _ = _trtrs(front.factor, solved, lower=1)
                flat[own:] -= front.coupling.T @ result[node]
            if len(front.above):
                above = flat[own:].reshape(-1, 6)
                passed.setdefault(tree.nodes[node].parent, []).append((front.above, above))
        return result

    def _backward(self, solved: dict[int, Array], poses: Array, holding: set[int]) -> Step:
        moves: dict[int, Array] = {}
        rigid: list[tuple[Numbers, Array]] = []
        stack = [0]
        while stack:
            node = stack.pop()
            front = self._fronts[node]
            above = np.array([moves[v] for v in front.above.tolist()]).reshape(-1, 6)
            if node not in solved and node not in holding:
                # Nothing below has a gradient either: it would have passed through here. And what
                # holds a vertex must not drift with its surroundings.
                motion = _rigid_motion(above, poses[front.above])
                if motion is not None:
                    rigid.append((self._below(node), motion))
                    continue
            if len(front.own):
                rhs = solved.get(node)
                flat = np.zeros(6 * len(front.own)) if rhs is None else rhs
                if len(above):
                    flat = flat - front.coupling @ above.ravel()
                own, _ = _trtrs(front.factor, flat, lower=1, trans=1)
                moves.update(zip(front.own.tolist(), own.reshape(-1, 6), strict=True))
            stack.extend(self._tree.nodes[node].children)
        vertices = np.array(sorted(moves), dtype=np.int64)
        tangents = np.array([moves[v] for v in vertices.tolist()]).reshape(-1, 6)
        return Step(vertices, tangents, tuple(rigid))

    def _below(self, node: int) -> Numbers:
        """All vertices of a node and of those below it."""
        found: list[int] = []
        stack = [node]
        while stack:
            this = self._tree.nodes[stack.pop()]
            found.extend(this.own)
            stack.extend(this.children)
        return np.array(found, dtype=np.int64)

    def _eliminated(self, node: int, blocks: Blocks, held: set[int]) -> Front:
        own = self._tree.nodes[node].own
        below = [self._fronts[child] for child in self._tree.nodes[node].children]
        touched = set(blocks.source.tolist()) | set(blocks.target.tolist())
        touched.update(*(front.above.tolist() for front in below))
        above = sorted(touched.difference(own))
        place = {vertex: index for index, vertex in enumerate((*own, *above))}
        size = len(place)
        matrix = np.zeros((6 * size, 6 * size))
        _add_edges(matrix, place, blocks)
        for front in below:
            rows = _rows([place[v] for v in front.above.tolist()])
            matrix[np.ix_(rows, rows)] += front.condensed
        split = 6 * len(own)
        diagonal = matrix.ravel()[:: 6 * size + 1][:split]
        diagonal += DAMPING
        for vertex in held.intersection(own):
            diagonal[6 * place[vertex] : 6 * place[vertex] + 6] += HELD
        return _front(np.array(own, np.int64), np.array(above, np.int64), matrix, split)


def _rigid_motion(tangents: Array, poses: Array) -> Array | None:
    """The motion (4, 4) in the world that vertices (k, 4, 4) share; None if they bend."""
    if not len(poses):
        return np.eye(4)
    centre = np.eye(4)
    centre[:3, 3] = poses[:, :3, 3].mean(axis=0)
    to_vertex = stacked.adjoint(stacked.inverse(poses) @ centre)
    shared = np.linalg.solve(to_vertex, tangents[..., None])[..., 0].mean(axis=0)
    bent = np.abs(tangents - to_vertex @ shared) * REACH
    if bent.max() > STRAIN_M:
        return None
    return centre @ stacked.exp(shared[None])[0] @ stacked.inverse(centre[None])[0]


def _is_like(front: Front, before: Front) -> bool:
    """Whether a node says about the vertices above nearly what it said before."""
    if not np.array_equal(front.above, before.above):
        return False
    scale = np.sqrt(np.maximum(np.diagonal(before.condensed), DAMPING))
    change = np.abs(front.condensed - before.condensed)
    return bool((change <= LIKENESS * np.outer(scale, scale)).all())


def _front(own: Numbers, above: Numbers, matrix: Array, split: int) -> Front:
    if not split:
        return Front(own, above, np.zeros((0, 0)), np.zeros((0, len(matrix))), matrix)
    factor, info = _potrf(matrix[:split, :split], lower=1, clean=1)
    if info:
        raise np.linalg.LinAlgError(f"vertex {own[max(info - 1, 0) // 6]} is not held by its edges")
    if not len(above):
        return Front(own, above, factor, np.zeros((split, 0)), np.zeros((0, 0)))
    coupling = _trsm(1.0, factor, matrix[:split, split:], lower=1)
    condensed = matrix[split:, split:] - coupling.T @ coupling
    return Front(own, above, factor, coupling, condensed)


def _add_edges(matrix: Array, place: Mapping[int, int], blocks: Blocks) -> None:
    count = len(matrix) // 6
    cells = matrix.reshape(count, 6, count, 6).transpose(0, 2, 1, 3)
    source = np.array([place[v] for v in blocks.source.tolist()], dtype=np.int64)
    target = np.array([place[v] for v in blocks.target.tolist()], dtype=np.int64)
    np.add.at(cells, (source, source), blocks.source_source)
    np.add.at(cells, (target, target), blocks.target_target)
    np.add.at(cells, (source, target), blocks.source_target)
    np.add.at(cells, (target, source), blocks.source_target.swapaxes(1, 2))


def _places(front: Front, vertices: Numbers) -> Numbers:
    place = {v: i for i, v in enumerate((*front.own.tolist(), *front.above.tolist()))}
    return np.array([place[v] for v in vertices.tolist()], dtype=np.int64)


def _rows(places: list[int]) -> Numbers:
    return (6 * np.array(places, dtype=np.int64)[:, None] + np.arange(6)).ravel()
