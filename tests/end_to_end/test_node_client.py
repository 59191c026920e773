"""A client in another language: Node.js loads the .proto and reads a live server."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from magic_agent.client import MagicClient
from magic_core.gaussians.ply import read_ply
from magic_server.server import Server
from tests.end_to_end.client_files import blobs_of, spoil, write_submap
from tests.small_world import DIMENSION, LARGE, MODEL_ID, make_submap

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "clients" / "node"


async def run(*command: str, timeout_s: float = 120.0) -> tuple[int, str]:
    """Exit code and output of a command in the example's folder."""
    process = await asyncio.create_subprocess_exec(
        *command,
        cwd=FOLDER,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(timeout_s):
        output, _ = await process.communicate()
    return process.returncode or 0, output.decode()


async def install() -> None:
    """The example's exact dependencies, unless they are there; skips where that cannot be."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("Node.js is not installed")
    installed = FOLDER / "node_modules" / ".package-lock.json"
    wanted = FOLDER / "package-lock.json"
    if installed.exists() and installed.stat().st_mtime >= wanted.stat().st_mtime:
        return
    code, output = await run("npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund")
    if code:
        pytest.skip(f"npm cannot install the example's dependencies: {output[-300:]}")


async def ask(server: Server, *arguments: str) -> tuple[int, dict]:
    """Exit code and answer of the example client."""
    code, output = await run("node", "client.js", server.address, *arguments)
    return code, json.loads(output)


async def test_node_submits_submaps(server: Server, client: MagicClient, tmp_path: Path) -> None:
    await install()
    files = write_submap(tmp_path / "agent_0", agent=0)
    code, answer = await ask(server, "submit", *files)
    assert (code, answer.get("duplicate")) == (0, False), answer
    assert answer["submap"] == "sessions/room/agents/agent_0/submaps/0"
    stored = await client.download_encoded(answer["submap"])
    assert list(stored.blobs) == blobs_of(files)
    assert (await ask(server, "submit", *files))[1]["duplicate"]
    spoil(files)
    code, answer = await ask(server, "submit", *files)
    assert (code, answer["error"]["code"]) == (1, "DATA_LOSS")
    assert len(await client.list_submaps("room")) == 1


async def test_node_reads_poses_loops_and_the_map(
    server: Server, client: MagicClient, tmp_path: Path
) -> None:
    await install()
    for agent in range(2):
        await client.register_agent(
            "room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION
        )
        await client.submit_submap(make_submap(agent=agent, camera=LARGE, submaps=3))
    coordinator = await server.sessions.named("room")
    assert await coordinator.idle(timeout_s=600)

    expected = await client.get_corrected_poses("room")
    code, snapshot = await ask(server, "poses", "room")
    assert code == 0
    assert snapshot["session"] == "sessions/room"
    assert int(snapshot["revision"]) == expected.revision
    assert [pose["submap"] for pose in snapshot["poses"]] == list(expected.poses)
    for pose in snapshot["poses"]:
        mine = expected.poses[pose["submap"]]
        assert pose["component"] == mine.component
        values = pose["world_from_anchor"]
        translation = [values[axis] for axis in ("x", "y", "z")]
        np.testing.assert_allclose(translation, mine.world_from_anchor[:3, 3], atol=1e-12)
        norm = np.linalg.norm([values[part] for part in ("qw", "qx", "qy", "qz")])
        assert norm == pytest.approx(1.0, abs=1e-9)

    name = "sessions/room/agents/agent_1/submaps/0"
    recorded = (await client.query_loops(name)).candidates
    code, answer = await ask(server, "loops", name)
    assert code == 0
    assert len(answer["candidates"]) == len(recorded) == 1
    loop = answer["candidates"][0]
    assert loop["verdict"] == f"LOOP_VERDICT_{recorded[0].verdict}"
    assert loop["reason"] == recorded[0].reason
    assert {loop["source"], loop["target"]} == {name, name.replace("agent_1", "agent_0")}
    assert loop["similarity"] == pytest.approx(recorded[0].similarity)

    code, answer = await ask(server, "map", "room", f"{tmp_path}/map.ply")
    assert code == 0, answer
    assert len(read_ply(tmp_path / "map.ply")) == int(answer["map"]["gaussian_count"]) > 1000
    code, answer = await ask(server, "map", "nowhere", f"{tmp_path}/no.ply")
    assert (code, answer["error"]["code"]) == (1, "NOT_FOUND")
    assert not (tmp_path / "no.ply").exists()

    code, answer = await ask(server, "poses", "nowhere")
    assert code == 1
    assert answer["error"]["code"] == "NOT_FOUND"
    assert "sessions/nowhere does not exist" in answer["error"]["message"]
