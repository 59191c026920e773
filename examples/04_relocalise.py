"""Where was this image taken? Answers from a map that was stored before.

magic serve --data-dir runs/demo/server &
python examples/04_relocalise.py ~/recordings/office 120
"""

from __future__ import annotations

import asyncio
import sys

import numpy as np

from magic_agent.client import MagicClient
from magic_agent.places import load_descriptor_model
from magic_core.data import open_dataset
from magic_core.errors import NotLocalized


async def main(
    dataset: str, frame: str = "0", server: str = "127.0.0.1:50051", session: str = "run"
) -> np.ndarray | None:
    """Place one frame of a recording; returns world_from_camera (4, 4), or None."""
    source = open_dataset(dataset)[0]
    image = source[int(frame)]
    descriptor = load_descriptor_model().describe(image.colour)
    async with MagicClient(server) as client:
        try:
            found = await client.localize(
                session, camera=source.camera, colour=image.colour, depth=image.depth,
                descriptor=descriptor,
            )  # fmt: skip
        except NotLocalized as error:
            print(f"not in this map: {error}")
            return None
    x, y, z = found.world_from_camera[:3, 3]
    print(f"at {x:.3f}, {y:.3f}, {z:.3f} m in the frame of {found.component}")
    print(f"seen from {found.submap}, overlap {found.overlap:.2f}, {found.inliers} inliers")
    return found.world_from_camera


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
