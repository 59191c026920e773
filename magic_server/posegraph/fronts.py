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

from magic_server.posegraph import packed, stacked
from magic_server.posegraph.dissection import Dissection

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Numbers = NDArray[np.int64]
(_potrf,) = get_lapack_funcs(("potrf",), dtype=np.float64)
(_trsm,) = get_blas_funcs(("trsm",), dtype=np.float64)

DAMPING = 1e-6
"""Added to each diagonal: a vertex that no edge holds in some direction stays where it is."""
HELD = 1e12
"""Information that holds a vertex."""
LIKENESS = 0.002
"""Condensed matrices that differ by less, relative to their diagonals, do for a while."""
STRAIN_M = 1e-3
"""What lies below separators that bend by less moves as one rigid body."""
STILL_M = 1e-4
"""What lies below separators that move by less stays."""
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
    """One eliminated node.

    What steps are solved with may be rounded: together it still is a positive definite matrix.
    What separators above are made of may not: their softest motions would be lost in it.
    """

    own: Numbers  # (p,) vertices
    above: Numbers  # (b,) vertices of the separators that it touches, ascending
    factor: Single  # 6p x 6p, lower triangle
    coupling: Single  # (6p, 6b) factor^-1 of the block between own and above
    condensed: Array  # 6b x 6b, lower triangle: what it says about the vertices above

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

    @property
    def moving(self) -> Numbers:
        """All vertices that move."""
        return np.concatenate([self.vertices, *(vertices for vertices, _ in self.rigid)])

    def scaled(self, share: float) -> Step:
        """A share of the step, in its direction."""
        rigid = ((v, stacked.exp(share * stacked.log(motion[None]))[0]) for v, motion in self.rigid)
        return Step(self.vertices, share * self.tangents, tuple(rigid))


class Fronts:
    """The eliminated nodes of a dissection."""

    def __init__(self, tree: Dissection) -> None:
        self._tree = tree
        self._fronts: dict[int, Front] = {}

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
        upwards: bool = True,
    ) -> set[int]:
        """Eliminate nodes again, `blocks` being the edges that lie in each; which ones were.

        `upwards`, the nodes above follow as far as what they are told changes: as long as that is
        little, they go on with what they were told before.
        """
        nodes = self._tree.nodes
        waiting, done = set(stale), set[int]()
        while waiting:
            node = max(waiting, key=lambda n: (nodes[n].depth, n))
            waiting.remove(node)
            done.add(node)
            before = self._fronts.get(node)
            front = self._eliminated(node, blocks(node), held)
            if before is not None and _is_like(front, before):
                front = replace(front, condensed=before.condensed)
            elif upwards and nodes[node].parent >= 0:
                waiting.add(nodes[node].parent)
            self._fronts[node] = front
        return done

    def step(self, vertices: Numbers, gradient: Array, poses: Array, held: set[int]) -> Step:
        """How all vertices move to where a gradient (n, 6), zero but at `vertices`, vanishes."""
        tree = self._tree
        holding = {node for vertex in held for node in tree.path(tree.node_of[vertex])}
        reached = set[int]()
        for node in {tree.node_of[vertex] for vertex in vertices.tolist()}:
            while node >= 0 and node not in reached:
                reached.add(node)
                node = tree.nodes[node].parent
        return self._backward(self._forward(reached, gradient), poses, holding)

    def _forward(self, reached: Collection[int], gradient: Array) -> dict[int, Single]:
        """Right-hand sides of the nodes that a gradient reaches, after elimination."""
        nodes, result = self._tree.nodes, {}
        total = -gradient
        for node in sorted(reached, key=lambda n: (-nodes[n].depth, n)):
            front = self._fronts[node]
            own = total[front.own].astype(np.float32).ravel()
            result[node] = solved = packed.solved(front.factor, own)
            if len(front.above):
                # A vertex is once at most among those above.
                total[front.above] -= (solved @ front.coupling).reshape(-1, 6)
        return result

    def _backward(self, solved: dict[int, Single], poses: Array, holding: set[int]) -> Step:
        moves = np.zeros((len(poses), 6))
        moving: list[Numbers] = []
        rigid: list[tuple[Numbers, Array]] = []
        stack = [0]
        while stack:
            node = stack.pop()
            front = self._fronts[node]
            above = moves[front.above]
            if node not in solved and node not in holding:
                # Nothing below has a gradient either: it would have passed through here. And what
                # holds a vertex must not drift with its surroundings.
                if (np.abs(above) * REACH < STILL_M).all():
                    continue
                motion = _rigid_motion(above, poses[front.above])
                if motion is not None:
                    rigid.append((self._below(node), motion))
                    continue
            if len(front.own):
                rhs = solved.get(node)
                if rhs is None:
                    rhs = np.zeros(6 * len(front.own), dtype=np.float32)
                if len(above):
                    bent = front.coupling @ above.astype(np.float32).ravel()
                    rhs = (rhs - bent).astype(np.float32)
                own = packed.solved(front.factor, rhs, transposed=True)
                moves[front.own] = own.reshape(-1, 6)
                moving.append(front.own)
            stack.extend(self._tree.nodes[node].children)
        vertices = np.sort(np.concatenate(moving)) if moving else np.zeros(0, dtype=np.int64)
        return Step(vertices, moves[vertices], tuple(rigid))

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
            matrix[np.ix_(rows, rows)] += packed.symmetric(front.condensed, len(rows))
        split = 6 * len(own)
        diagonal = matrix.ravel()[:: 6 * size + 1][:split]
        diagonal += DAMPING
        for vertex in held.intersection(own):
            diagonal[6 * place[vertex] : 6 * place[vertex] + 6] += HELD
        return _front(np.array(own, np.int64), np.array(above, np.int64), matrix, split)


def _rigid_motion(tangents: Array, poses: Array) -> Array | None:
    """The motion (4, 4) in the world that vertices (k, 4, 4) share; None if they bend."""
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
    size = 6 * len(front.above)
    scale = np.sqrt(np.maximum(packed.diagonal(before.condensed, size), DAMPING))
    change = np.abs(front.condensed - before.condensed)
    return bool((change <= LIKENESS * packed.lower(np.outer(scale, scale))).all())


def _front(own: Numbers, above: Numbers, matrix: Array, split: int) -> Front:
    factor, coupling = np.zeros((0, 0)), np.zeros((split, 6 * len(above)))
    if split:
        factor, info = _potrf(matrix[:split, :split], lower=1, clean=1)
        if info:
            vertex = own[max(info - 1, 0) // 6]
            raise np.linalg.LinAlgError(f"vertex {vertex} is not held by its edges")
        if len(above):
            coupling = _trsm(1.0, factor, matrix[:split, split:], lower=1)
    condensed = matrix[split:, split:] - coupling.T @ coupling
    return Front(
        own,
        above,
        factor=packed.lower(factor).astype(np.float32),
        coupling=coupling.astype(np.float32),
        condensed=packed.lower(condensed),
    )


def _add_edges(matrix: Array, place: Mapping[int, int], blocks: Blocks) -> None:
    count = len(matrix) // 6
    cells = matrix.reshape(count, 6, count, 6).transpose(0, 2, 1, 3)
    source = np.array([place[v] for v in blocks.source.tolist()], dtype=np.int64)
    target = np.array([place[v] for v in blocks.target.tolist()], dtype=np.int64)
    np.add.at(cells, (source, source), blocks.source_source)
    np.add.at(cells, (target, target), blocks.target_target)
    np.add.at(cells, (source, target), blocks.source_target)
    np.add.at(cells, (target, source), blocks.source_target.swapaxes(1, 2))


def _rows(places: list[int]) -> Numbers:
    return (6 * np.array(places, dtype=np.int64)[:, None] + np.arange(6)).ravel()
