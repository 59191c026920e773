"""Three agents that start anywhere, one server, one map: everything in this process.

Agents on machines of their own do the same; only the address differs. `magic run` does it with one
process per agent.

    python examples/02_three_agents.py [OUTPUT_FOLDER]
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
from magic_core.gaussians.ply import write_ply
from magic_server.config import ListenConfig, ServerConfig
from magic_server.server import Server

DATASET = "synthetic://flat?agents=3&frames=60&width=160&height=120&detail=draft"


async def main(out: Path) -> int:
    """Map the flat into `out`; returns how many components the agents ended in."""
    sources = open_dataset(DATASET)
    model = load_descriptor_model()
    config = ServerConfig(data_dir=out / "server", listen=ListenConfig(port=0))
    async with Server(config) as server, MagicClient(server.address) as client:

        async def run(source) -> None:
            agent = Agent(
                source, client, session="flat", name=source.name, config=AgentConfig(),
                model=model, folder=out / source.name,
            )  # fmt: skip
            tally = await agent.run()
            print(f"{source.name}: {tally.frames} frames, {tally.acknowledged} sub-maps")

        async with asyncio.TaskGroup() as group:
            for source in sources:
                group.create_task(run(source))
        # A merge waits for loops that are still being verified, and for the poses that follow.
        info = await client.build_global_map("flat")
        write_ply(out / "map.ply", await client.get_global_map(info.name))
        print(f"{info.gaussian_count:,} Gaussians in {out / 'map.ply'}")
        snapshot = await client.get_corrected_poses("flat")
        for component in snapshot.components:
            agents = ", ".join(name.rpartition("/")[2] for name in component.agents)
            print(f"{component.submap_count} sub-maps in one frame: {agents}")
        return len(snapshot.components)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")))
