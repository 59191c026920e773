"""A server that was killed goes on: loops are verified, merges finish, damage is named."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from magic_agent.client import MagicClient
from magic_core.errors import CorruptData
from magic_core.wire.records import OperationStatus
from tests.faults.server_process import ServerForge
from tests.small_world import DIMENSION, LARGE, MODEL_ID, make_submap

ROOM = "room"


async def submit(client: MagicClient, *, agents: int = 2, submaps: int = 1) -> None:
    for agent in range(agents):
        await client.register_agent(ROOM, f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION)
        for index in range(submaps):
            submap = make_submap(ROOM, agent, index, camera=LARGE, submaps=3)
            await client.submit_submap(submap)


async def verdicts(client: MagicClient) -> list[str]:
    return [loop.verdict for loop in (await client.list_loops(ROOM)).candidates]


async def until_verdict(client: MagicClient, *, settled: bool) -> list[str]:
    """The verdicts, once there is one and all are settled (or at least one is not)."""
    async with asyncio.timeout(200):
        while True:
            found = await verdicts(client)
            if found and ("PENDING" not in found if settled else "PENDING" in found):
                return found
            await asyncio.sleep(0.01)


def settings(folder: Path) -> dict:
    return {"data_dir": str(folder), "min_similarity": 0.3}


@pytest.mark.slow
async def test_a_loop_under_verification_is_verified_by_the_next_server(tmp_path: Path) -> None:
    async with ServerForge() as forge:
        server = await forge.start(settings(tmp_path))
        async with MagicClient(await server.ready()) as client:
            await submit(client)
            await until_verdict(client, settled=False)
        await server.end()
        server = await forge.start(settings(tmp_path))
        async with MagicClient(await server.ready()) as client:
            assert await until_verdict(client, settled=True) == ["ACCEPTED"]
            async with asyncio.timeout(100):
                while True:
                    snapshot = await client.get_corrected_poses(ROOM)
                    if len(snapshot.components) == 1:
                        break
                    await asyncio.sleep(0.1)
            assert len(snapshot.poses) == 2
        await server.end()


@pytest.mark.slow
async def test_a_merge_goes_on_after_a_kill(tmp_path: Path) -> None:
    async with ServerForge() as forge:
        server = await forge.start(settings(tmp_path))
        async with MagicClient(await server.ready()) as client:
            await submit(client)
            await until_verdict(client, settled=True)
            operation = await client.start_global_map(ROOM, coarse_only=True, request_id="map")
            await running(client, operation)
        await server.end()
        server = await forge.start(settings(tmp_path))
        async with MagicClient(await server.ready()) as client:
            again = await client.start_global_map(ROOM, coarse_only=True, request_id="map")
            assert again.name == operation.name
            done = await client.wait_operation(again, timeout_s=200)
            assert done.state == "SUCCEEDED"
            cloud = await client.get_global_map(done.result.name)
            assert len(cloud) == done.result.gaussian_count > 1000
            assert len(await client.list_operations(ROOM)) == 1
        await server.end()
        assert merges_in(tmp_path) == []


def merges_in(folder: Path) -> list[Path]:
    """What merges have left behind."""
    return list(folder.glob("merge-*"))


async def running(client: MagicClient, operation: OperationStatus) -> None:
    """Wait until the merge computes."""
    async with asyncio.timeout(200):
        while True:
            if (await client.get_operation(operation.name)).state != "PENDING":
                return
            await asyncio.sleep(0.01)


async def test_a_damaged_file_is_named_when_it_is_read(tmp_path: Path) -> None:
    async with ServerForge() as forge:
        server = await forge.start({"data_dir": str(tmp_path)})
        async with MagicClient(await server.ready()) as client:
            await submit(client, agents=1)
            header = (await client.get_submap(f"sessions/{ROOM}/agents/agent_0/submaps/0"))[1]
            digest = header.blobs[header.gaussians_blob].sha256.hex()
            blob = tmp_path / "blobs" / digest[0] / digest
            data = bytearray(blob.read_bytes())
            data[100] ^= 1
            blob.write_bytes(data)
            with pytest.raises(CorruptData, match=f"{digest} is damaged"):
                await client.download_encoded(header.name)
            async with asyncio.timeout(100):
                while True:
                    if (await client.get_corrected_poses(ROOM)).poses:
                        break
                    await asyncio.sleep(0.05)
            with pytest.raises(CorruptData, match=f"{digest} is damaged"):
                await client.build_global_map(ROOM, coarse_only=True, timeout_s=200)
        await server.end()
