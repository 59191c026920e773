"""The job that finds the optimum of what counts in a large pose graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from magic_server.posegraph.settlement import CountedArrays, Optimum


def settle_pose_graph(graph: CountedArrays) -> Optimum:
    """Move all poses to where the edges that count want them."""
    from magic_server.posegraph.settlement import settled

    return settled(graph)
