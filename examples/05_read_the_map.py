"""Read what a server has: sessions, corrected poses, loops and the map; render it to a picture.

Node.js and C++ clients do the same in examples/clients.

    python examples/05_read_the_map.py 127.0.0.1:50051 view.png
"""

from __future__ import annotations

import asyncio
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from PIL import Image

from magic_agent.client import MagicClient
from magic_core.gaussians import GaussianCloud
from magic_core.render import Rasteriser


async def main(server: str = "127.0.0.1:50051", picture: str = "view.png") -> Path:
    """Print the newest session and render it from its first anchor."""
    async with MagicClient(server) as client:
        session = (await client.list_sessions())[-1]
        name = session.name.removeprefix("sessions/")
        snapshot = await client.get_corrected_poses(name)
        loops = (await client.list_loops(name)).candidates
        print(f"{session.name}: {session.agent_count} agents, {session.submap_count} sub-maps")
        print("loops:", dict(Counter(loop.reason for loop in loops)) or "none yet")

        # The map is its sub-maps, each moved by one transform. No merge is needed to look at it.
        component = snapshot.components[0].id
        clouds = []
        for pose in snapshot.poses.values():
            if pose.component == component:
                submap = await client.download_submap(pose.submap)
                clouds.append(submap.gaussians.transformed(pose.world_from_anchor))
    first = snapshot.poses[component].world_from_anchor
    view = Rasteriser().render(GaussianCloud.concatenate(clouds), submap.camera, first)
    path = Path(picture)
    Image.fromarray((np.clip(view.colour, 0, 1) * 255).astype(np.uint8)).save(path)
    print(f"{path}: rendered from the first anchor, {view.alpha.mean():.0%} covered")
    return path


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
