"""Where agents with unknown starts stand relative to each other, before any optimisation.

Every loop between two chains votes for the transform between them. The loop with most mates wins
its pair of chains; chains are then placed along the spanning tree of the strongest pairs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_server.posegraph import stacked
from magic_server.posegraph.arrays import EdgeArrays
from magic_server.posegraph.chains import Chains
from magic_server.posegraph.consistency import mates, oriented_by_age, votes

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Consensus:
    """What the loops between two chains agree on."""

    first: int
    second: int
    first_from_second: Array  # (4, 4) between the chains' frames
    support: float
    """How many loops agree, the winner included."""


def consensus_of_pair(
    loops: EdgeArrays, chains: Chains, *, weights: Array | None = None, scale: float = 1.0
) -> Consensus:
    """The best supported vote among loops that join one pair of chains."""
    oriented = oriented_by_age(loops, chains)
    agreeing = mates(oriented, chains, scale=scale)
    weight = np.ones(len(loops)) if weights is None else weights
    support = weight * (1.0 + agreeing @ weight)
    best = int(support.argmax())
    return Consensus(
        first=int(chains.chain[oriented.source[0]]),
        second=int(chains.chain[oriented.target[0]]),
        first_from_second=votes(oriented.select(np.array([best])), chains)[0],
        support=float(support[best]),
    )


def place(
    chains: Chains,
    loops: EdgeArrays,
    known: Mapping[int, Array],
    *,
    weights: Array | None = None,
    scale: float = 1.0,
) -> Array:
    """Poses (n, 4, 4) of all vertices: each chain moved rigidly to where the loops place it.

    `known` holds `world_from_chain` of chains with a known start; without any, the oldest chain
    defines the world. Chains that no loop reaches stay at identity.
    """
    consensus = _all_pairs(chains, loops, weights, scale)
    world_from_chain = dict(known) or {chains.oldest[0]: np.eye(4)}
    for pair in _strongest_first(consensus, world_from_chain, chains):
        if pair.second in world_from_chain:
            moved = world_from_chain[pair.second] @ _inverse(pair.first_from_second)
            world_from_chain[pair.first] = moved
        else:
            moved = world_from_chain[pair.first] @ pair.first_from_second
            world_from_chain[pair.second] = moved
    frames = np.array([world_from_chain.get(int(chain), np.eye(4)) for chain in chains.chain])
    return frames @ chains.poses


def known_frames(chains: Chains, priors: Mapping[int, Array]) -> dict[int, Array]:
    """world_from_chain of the chains that have a vertex with a prior; the oldest one counts."""
    known: dict[int, Array] = {}
    for vertex in sorted(priors):
        chain = int(chains.chain[vertex])
        known.setdefault(chain, priors[vertex] @ _inverse(chains.poses[vertex]))
    return known


def _all_pairs(
    chains: Chains, loops: EdgeArrays, weights: Array | None, scale: float
) -> list[Consensus]:
    a, b = chains.chain[loops.source], chains.chain[loops.target]
    low, high = np.minimum(a, b), np.maximum(a, b)
    found = []
    for first, second in sorted(
        {(x, y) for x, y in zip(low.tolist(), high.tolist(), strict=True) if x != y}
    ):
        index = np.flatnonzero((low == first) & (high == second))
        chosen = None if weights is None else weights[index]
        found.append(consensus_of_pair(loops.select(index), chains, weights=chosen, scale=scale))
    return found


def _strongest_first(
    consensus: list[Consensus], placed: dict[int, Array], chains: Chains
) -> list[Consensus]:
    """The spanning tree that grows from the placed chains, always by the best supported pair."""
    inside, tree = set(placed), []
    while True:
        reachable = [c for c in consensus if (c.first in inside) != (c.second in inside)]
        if not reachable:
            rest = [chain for chain in chains.oldest if chain not in inside]
            if not rest:
                return tree
            inside.add(rest[0])
            continue
        best = max(reachable, key=lambda c: (c.support, -c.first, -c.second))
        inside |= {best.first, best.second}
        tree.append(best)


def _inverse(transform: Array) -> Array:
    return stacked.inverse(transform[None])[0]
