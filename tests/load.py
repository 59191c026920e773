"""Agents that upload large sub-maps, as a process of its own: `python -m tests.load ADDRESS`."""

from __future__ import annotations

import argparse
import asyncio
import dataclasses

import numpy as np

from magic_agent.client import ClientConfig, MagicClient
from magic_core.geometry import Camera
from magic_core.submap import Keyframe
from magic_core.wire import EncodedSubmap, SubmapEncoding, encode_submap
from tests.small_world import DIMENSION, MODEL_ID, make_submap

RENDERED = Camera(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)


def encoded(agent: int, index: int, *, submaps: int) -> EncodedSubmap:
    """A sub-map of several megabytes: 640x480, four noisy keyframes, 19,200 Gaussians, lossless."""
    submap = make_submap(
        "load", agent, index, camera=RENDERED, frames=50, keyframes=4, submaps=submaps
    )
    rng = np.random.default_rng([agent, index])
    large = tuple(_large_and_noisy(keyframe, rng) for keyframe in submap.keyframes)
    submap = dataclasses.replace(submap, camera=RENDERED.scaled(2.0), keyframes=large)
    return encode_submap(submap, request_id=submap.name, encoding=SubmapEncoding.lossless())


def _large_and_noisy(keyframe: Keyframe, rng: np.random.Generator) -> Keyframe:
    """The keyframe at twice the size, with a sensor's noise, which makes real images large."""
    colour = keyframe.colour.repeat(2, axis=0).repeat(2, axis=1)
    depth = keyframe.depth.repeat(2, axis=0).repeat(2, axis=1)
    colour = np.clip(colour + rng.integers(-3, 4, colour.shape), 0, 255).astype(np.uint8)
    depth = (depth + rng.normal(0.0, 0.003, depth.shape)).astype(np.float32)
    return dataclasses.replace(keyframe, colour=colour, depth=depth)


async def upload(client: MagicClient, agent: int, submaps: list[EncodedSubmap]) -> None:
    """One agent's session from registration to the end."""
    await client.register_agent("load", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION)
    for submap in submaps:
        await client.submit_encoded(submap)
    await client.finish_agent("load", f"agent_{agent}")


async def main() -> None:
    """Upload from several agents at once; prints the bytes sent."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("address")
    parser.add_argument("--agents", type=int, default=2)
    parser.add_argument("--submaps", type=int, default=2)
    options = parser.parse_args()
    work = [
        [encoded(agent, index, submaps=options.submaps) for index in range(options.submaps)]
        for agent in range(options.agents)
    ]
    async with MagicClient(options.address, ClientConfig(rpc_timeout_s=60.0)) as client:
        await asyncio.gather(*(upload(client, agent, one) for agent, one in enumerate(work)))
    print(sum(submap.wire_bytes for one in work for submap in one))


if __name__ == "__main__":
    asyncio.run(main())
