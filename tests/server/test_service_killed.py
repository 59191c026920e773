"""A server that is killed while sub-maps arrive loses none that it acknowledged."""

from __future__ import annotations

import asyncio
import random
import signal
import sys
from pathlib import Path

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import MagicError
from magic_core.wire import EncodedSubmap, encode_submap
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually

REPOSITORY = Path(__file__).resolve().parents[2]
SERVE = """
import asyncio, pathlib, sys
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import serve
config = ServerConfig(
    data_dir=pathlib.Path(sys.argv[1]),
    listen=ListenConfig(port=0),
    jobs=JobConfig(workers=1),
    loops=LoopConfig(min_similarity=1.0),
)
asyncio.run(serve(config, on_ready=lambda server: print(server.address, flush=True)))
"""
SUBMAPS = 12


async def start(folder: Path) -> tuple[asyncio.subprocess.Process, str]:
    """A server process and its address."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", SERVE, str(folder), cwd=REPOSITORY, stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    return process, (await process.stdout.readline()).decode().strip()


async def upload(address: str, submaps: list[EncodedSubmap], acknowledged: set[str]) -> None:
    """Send every sub-map in order until the server is gone."""
    async with MagicClient(address, ClientConfig(attempts=1)) as client:
        for submap in submaps:
            await client.submit_encoded(submap)
            acknowledged.add(submap.header.name)


async def test_what_was_acknowledged_survives_kill_and_nothing_is_there_twice(
    tmp_path: Path,
) -> None:
    rng = random.Random(11)
    submaps = [
        encode_submap(make_submap(index=i, submaps=SUBMAPS), request_id=f"r{i}")
        for i in range(SUBMAPS)
    ]
    acknowledged: set[str] = set()
    for _ in range(2):
        process, address = await start(tmp_path)
        async with MagicClient(address) as client:
            await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        sending = asyncio.create_task(upload(address, submaps, acknowledged))
        # Somewhere among the next few sub-maps, at any point of one's way in.
        wanted = min(len(acknowledged) + 2, SUBMAPS - 1)
        await eventually(lambda w=wanted, s=sending: len(acknowledged) >= w or s.done())
        await asyncio.sleep(rng.uniform(0.0, 0.03))
        process.send_signal(signal.SIGKILL)
        await process.wait()
        assert isinstance((await asyncio.gather(sending, return_exceptions=True))[0], MagicError)

    process, address = await start(tmp_path)
    async with MagicClient(address) as client:
        stored = [info.name for info in await client.list_submaps("room")]
        assert len(stored) == len(set(stored)) < SUBMAPS
        assert acknowledged <= set(stored)
        assert len(acknowledged) >= 3
        for submap in submaps[: len(stored)]:
            found = await client.download_encoded(submap.header.name)
            assert (found.header, found.blobs) == (submap.header, submap.blobs)
        assert list((tmp_path / "incoming").iterdir()) == []
        wanted = {blob.sha256.hex() for s in submaps[: len(stored)] for blob in s.header.blobs}
        assert {file.name for file in (tmp_path / "blobs").rglob("*") if file.is_file()} == wanted
    process.send_signal(signal.SIGTERM)
    assert await process.wait() == 0
