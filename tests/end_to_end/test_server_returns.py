"""A server that dies and comes back costs an agent time and nothing else (real processes)."""

import asyncio
import signal

from magic_agent.client import MagicClient
from tests.end_to_end.conftest import first_line, wait_for


def test_an_agent_outlives_its_server(flat, processes, tmp_path):
    store = str(tmp_path / "store")
    server = processes.start(
        "server", "serve", "--data-dir", store, "--port", "0", "--progress", "json"
    )
    target = first_line(server)["target"]
    agent = processes.start(
        "agent", "agent", str(flat), "--server", target, "--session", "flat", "--name", "agent_0",
        "--out", str(tmp_path / "out"), "--progress", "json",
        "--submap.frames", "12", "--submap.min-frames", "6",
    )  # fmt: skip
    wait_for(agent, "submaps", 1)
    server.send_signal(signal.SIGKILL)
    server.wait()
    port = target.rsplit(":", 1)[1]
    again = processes.start(
        "again", "serve", "--data-dir", store, "--port", port, "--progress", "json"
    )
    assert first_line(again)["target"] == target
    agent.communicate(timeout=300)
    assert agent.returncode == 0, processes.log("agent")

    frames = asyncio.run(stored_frames(target))
    assert frames == list(range(36))
    assert not list((tmp_path / "out" / "agents" / "agent_0" / "spool").glob("*.submap"))


async def stored_frames(target: str) -> list[int]:
    """Every frame index in the stored trajectory of the agent, each exactly once."""
    async with MagicClient(target) as client:
        parts = await client.get_trajectory("flat", "agent_0")
        return [frame.frame_index for part in parts for frame in part.frames]
