"""Agents that come late, leave early or die take nobody with them (real processes)."""

import asyncio
import signal

from magic_agent.client import MagicClient
from tests.end_to_end.conftest import first_line, wait_for


def agent_arguments(flat, target: str, name: str, out) -> list[str]:
    options = ["--submap.frames", "12", "--submap.min-frames", "6", "--progress", "json"]
    place = ["--server", target, "--session", "flat", "--name", name, "--out", str(out)]
    return ["agent", str(flat), *place, *options]


def test_late_early_and_killed_agents_leave_a_map_of_what_arrived(flat, processes, tmp_path):
    server = processes.start(
        "server", "serve", "--data-dir", str(tmp_path / "store"), "--port", "0",
        "--progress", "json", "--merge.iterations", "20",
    )  # fmt: skip
    target = first_line(server)["target"]

    def start(name: str):
        return processes.start(name, *agent_arguments(flat, target, name, tmp_path / "out"))

    steady, leaving, killed = start("agent_0"), start("agent_1"), start("agent_2")
    wait_for(killed, "submaps", 1)
    killed.send_signal(signal.SIGKILL)
    wait_for(leaving, "submaps", 1)
    leaving.send_signal(signal.SIGTERM)
    late = start("agent_3")

    for name, process in (("agent_0", steady), ("agent_1", leaving), ("agent_3", late)):
        process.communicate(timeout=300)
        assert process.returncode == 0, processes.log(name)
    assert killed.wait() == -signal.SIGKILL

    agents, submaps, info, cloud, frames = asyncio.run(final_state(target))
    assert {agent: a.state for agent, a in agents.items()} == {
        "agent_0": "FINISHED",
        "agent_1": "FINISHED",
        "agent_2": "ACTIVE",
        "agent_3": "FINISHED",
    }
    assert agents["agent_2"].submap_count >= 1
    assert frames["agent_0"] == 36
    assert frames["agent_3"] == 36
    assert 12 <= frames["agent_1"] <= 36
    assert set(info.submaps) <= {submap.name for submap in submaps}
    assert len(cloud) == info.gaussian_count > 100
    assert server.poll() is None


async def final_state(target: str):
    """What the server holds once everybody is gone, and the map it makes of that."""
    async with MagicClient(target) as client:
        info = await client.build_global_map("flat", timeout_s=600)
        cloud = await client.get_global_map(info.name)
        listed = {agent.name.split("/")[-1]: agent for agent in await client.list_agents("flat")}
        submaps = await client.list_submaps("flat")
        frames = {
            agent: sum(len(p.frames) for p in await client.get_trajectory("flat", agent))
            for agent in listed
        }
        return listed, submaps, info, cloud, frames
