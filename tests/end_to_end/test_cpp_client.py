"""A client in C++: built from the contract with Debian's gRPC, it submits, queries and reads."""

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
from tests.end_to_end.client_files import blobs_of, write_submap

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "clients" / "cpp"
TOOLS = ("cmake", "c++", "make", "pkg-config", "protoc", "grpc_cpp_plugin")

pytestmark = pytest.mark.slow


async def run(*command: str, timeout_s: float = 900.0) -> tuple[int, str, str]:
    """Exit code, output and messages of a command."""
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    async with asyncio.timeout(timeout_s):
        output, messages = await process.communicate()
    return process.returncode or 0, output.decode(), messages.decode()


async def built(folder: Path) -> str:
    """The client, built; skips where its tools or libraries are missing."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing or (await run("pkg-config", "--exists", "grpc++"))[0]:
        pytest.skip(f"see {FOLDER / 'README.md'} for what to install; missing: {missing}")
    for command in (("-S", str(FOLDER), "-B", str(folder)), ("--build", str(folder))):
        code, output, messages = await run("cmake", *command)
        assert code == 0, (output + messages)[-3000:]
    return str(folder / "client")


async def test_cpp_submits_submaps_and_reads_loops_and_poses(
    server: Server, client: MagicClient, tmp_path: Path
) -> None:
    program = await built(tmp_path / "build")
    for agent in range(2):
        files = write_submap(tmp_path / f"agent_{agent}", agent=agent)
        code, output, messages = await run(program, server.address, "submit", *files)
        assert code == 0, messages
        name = f"sessions/room/agents/agent_{agent}/submaps/0"
        assert json.loads(output)["submap"] == name
        assert not json.loads(output)["duplicate"]
        stored = await client.download_encoded(name)
        assert list(stored.blobs) == blobs_of(files)
    _, output, _ = await run(program, server.address, "submit", *files)
    assert json.loads(output)["duplicate"]
    assert await (await server.sessions.named("room")).idle(timeout_s=600)

    _, output, _ = await run(program, server.address, "loops", name)
    (loop,) = json.loads(output)["candidates"]
    (expected,) = (await client.query_loops(name)).candidates
    assert loop["verdict"] == f"LOOP_VERDICT_{expected.verdict}"
    assert loop["target"] == expected.target

    _, output, _ = await run(program, server.address, "poses", "room")
    snapshot, mine = json.loads(output), await client.get_corrected_poses("room")
    assert int(snapshot["revision"]) == mine.revision
    assert [pose["submap"] for pose in snapshot["poses"]] == list(mine.poses)
    for pose in snapshot["poses"]:
        values = pose["world_from_anchor"]
        translation = [values[axis] for axis in ("x", "y", "z")]
        expected_pose = mine.poses[pose["submap"]].world_from_anchor
        np.testing.assert_allclose(translation, expected_pose[:3, 3], atol=1e-12)

    code, output, messages = await run(
        program, server.address, "map", "room", f"{tmp_path}/map.ply"
    )
    assert code == 0, messages
    assert len(read_ply(tmp_path / "map.ply")) == int(json.loads(output)["gaussian_count"]) > 1000
    code, _, messages = await run(program, server.address, "map", "nowhere", f"{tmp_path}/no.ply")
    assert code == 1
    assert not (tmp_path / "no.ply").exists()

    code, _, messages = await run(program, server.address, "poses", "nowhere")
    assert code == 1
    assert "sessions/nowhere does not exist" in messages
