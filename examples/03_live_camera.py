"""A live camera: frames come when they come, and the agent keeps up.

Start `magic serve --viewer` first. Then, with a RealSense (pip install 'magic-slam[realsense]'):

    python examples/03_live_camera.py realsense:

or a recording that is played in real time, which behaves in the same way:

    python examples/03_live_camera.py ~/recordings/office
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from magic_agent.agent import Agent
from magic_agent.client import MagicClient
from magic_agent.config import AgentConfig
from magic_agent.places import load_descriptor_model
from magic_core.data import open_dataset


async def main(dataset: str, server: str = "127.0.0.1:50051", out: str = "runs/live") -> int:
    """Map until the source ends or Ctrl-C; returns the number of frames that were tracked."""
    source = open_dataset(dataset)[0]
    config = AgentConfig(rate_hz=0.0 if dataset.startswith("realsense:") else 30.0)

    def show(event: str, figures: dict) -> None:
        if event == "revision":
            x, y, z = agent.world_from_camera[:3, 3]
            print(f"revision {figures['revision']}: the camera is at {x:.2f}, {y:.2f}, {z:.2f} m")

    async with MagicClient(server) as client:
        agent = Agent(
            source, client, session="live", name=source.name, config=config,
            model=load_descriptor_model(), folder=Path(out), observer=show,
        )  # fmt: skip
        tally = await agent.run()
    print(
        f"{tally.frames} frames tracked, {tally.lost_frames} lost, {tally.dropped_frames} dropped, "
        f"{tally.skipped_keyframes} keyframes skipped to keep up"
    )
    return tally.frames


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
