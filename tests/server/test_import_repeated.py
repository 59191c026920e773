"""An import that is repeated under its request id gets the first answer and stores nothing."""

from __future__ import annotations

import asyncio
import json
import random
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import grpc
import grpc.aio
import pytest
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_cli.main import run_command
from magic_core.errors import AlreadyExists, InvalidInput
from magic_core.wire import SubmapLimits, chunks_of, error_of
from magic_server.archive import Archives
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from magic_server.store import Store
from tests.faults.proxy import Proxy, Weather
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_files


@dataclass(frozen=True, slots=True)
class Exported:
    """A session's archive at two moments."""

    first: bytes
    later: bytes


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return asyncio.run(_exported(tmp_path_factory.mktemp("source")))


async def _exported(folder: Path) -> Exported:
    config = ServerConfig(
        data_dir=folder,
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        jobs=JobConfig(workers=1, niceness=0),
        loops=LoopConfig(enabled=False),
    )
    async with Server(config) as server, MagicClient(server.address) as client:
        await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        await client.submit_submap(make_submap())
        assert await (await server.sessions.named("room")).idle(timeout_s=600)
        first = b"".join([piece async for piece in client.export_session("room")])
        await client.finish_agent("room", "agent_0")
        later = b"".join([piece async for piece in client.export_session("room")])
    return Exported(first, later)


@dataclass(slots=True)
class Pieces:
    """An archive that can be read again, and how often that was begun."""

    data: bytes
    reads: int = 0

    async def __aiter__(self) -> AsyncIterator[bytes]:
        self.reads += 1
        for begin in range(0, len(self.data), 4096):
            yield self.data[begin : begin + 4096]


async def test_a_repeat_gets_the_first_answer_whatever_happened_since(
    archives: Exported, server_config: ServerConfig
) -> None:
    def pieces() -> Pieces:
        return Pieces(archives.first)

    async with Server(server_config) as server, MagicClient(server.address) as client:
        first = await client.import_session(pieces(), request_id="i")
        assert (first.name, first.agent_count, first.submap_count) == ("sessions/room", 1, 1)
        assert first == await client.get_session("room")
        files = set(stored_files(server_config))
        await client.register_agent("room", "agent_1", model_id=MODEL_ID, dimension=DIMENSION)
        assert await client.import_session(pieces(), request_id="i") == first
        with pytest.raises(AlreadyExists, match="delete it before"):
            await client.import_session(pieces(), request_id="another")
        assert (await client.get_session("room")).agent_count == 2
        assert set(stored_files(server_config)) == files
    async with Server(server_config) as server, MagicClient(server.address) as client:
        assert await client.import_session(pieces(), request_id="i") == first
        await client.delete_session("room", force=True)
        assert await client.import_session(pieces(), request_id="i") == first
        assert await client.list_sessions() == ()
        assert stored_files(server_config) == []
        again = await client.import_session(pieces(), request_id="another")
        assert again == first


async def test_a_request_id_is_not_used_for_another_archive(
    archives: Exported, client: MagicClient
) -> None:
    await client.import_session(Pieces(archives.first), request_id="i")
    with pytest.raises(AlreadyExists, match="'i' was used for another archive of sessions/room"):
        await client.import_session(Pieces(archives.later), request_id="i")
    assert (await client.list_agents("room"))[0].state == "ACTIVE"


async def test_a_refused_import_leaves_its_id_free(archives: Exported, client: MagicClient) -> None:
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    with pytest.raises(AlreadyExists, match="delete it before"):
        await client.import_session(Pieces(archives.first), request_id="i")
    await client.delete_session("room", force=True)
    assert (await client.import_session(Pieces(archives.later), request_id="i")).submap_count == 1


async def test_the_same_import_twice_at_once_stores_one_session(
    archives: Exported, client: MagicClient, server_config: ServerConfig
) -> None:
    calls = (client.import_session(Pieces(archives.first), request_id="i") for _ in range(4))
    first, *others = await asyncio.gather(*calls)
    assert others == [first] * 3
    assert await client.list_sessions() == (first,)
    submap = await client.download_encoded("sessions/room/agents/agent_0/submaps/0")
    digests = {blob.sha256.hex() for blob in submap.header.blobs}
    assert stored_files(server_config) == sorted(digests)


@pytest.mark.parametrize(
    ("ids", "said"),
    [
        (("", ""), "request_id"),
        (("x" * 129, ""), "request_id"),
        (("line\nbreak", ""), "request_id"),
        (("i", "other"), "not that of the stream's first message"),
        ((), "request_id"),
    ],
)
async def test_an_import_without_one_id_is_refused_and_leaves_nothing(
    ids: tuple[str, ...], said: str, archives: Exported, server: Server
) -> None:
    half = len(archives.first) // 2
    offsets = (0, half)
    requests = []
    for request_id, offset in zip(ids, offsets, strict=False):
        (chunk,) = chunks_of(archives.first[offset : offset + half][: 1 << 20])
        chunk.offset = offset
        requests.append(session_pb.ImportSessionRequest(chunk=chunk, request_id=request_id))
    async with grpc.aio.insecure_channel(server.address) as channel:
        stub = session_grpc.SessionServiceStub(channel)
        with pytest.raises(grpc.RpcError) as refused:
            await stub.ImportSession(iter(requests), timeout=60)
    error = error_of(refused.value)
    assert isinstance(error, InvalidInput)
    assert said in str(error)
    assert error.violations[0].field == "request_id"
    assert stored_files(server.config) == []


async def test_an_import_whose_connection_breaks_is_sent_again(
    archives: Exported, server: Server
) -> None:
    weather = Weather(cut_after=(len(archives.first) // 4, len(archives.first) // 2), cuts=2)
    config = ClientConfig(backoff_s=0.05)
    async with Proxy(server.address, weather, random.Random(3)) as proxy:
        async with MagicClient(proxy.address, config) as client:
            pieces = Pieces(archives.first)
            info = await client.import_session(pieces)
        assert proxy.traffic.cuts == 2
    assert pieces.reads == 3
    async with MagicClient(server.address) as client:
        assert await client.list_sessions() == (info,)


async def test_an_archive_that_cannot_be_read_is_no_broken_connection(
    archives: Exported, client: MagicClient
) -> None:
    class Unreadable(Pieces):
        async def __aiter__(self) -> AsyncIterator[bytes]:
            async for piece in super().__aiter__():
                yield piece
                raise OSError("the disk broke")

    pieces = Unreadable(archives.first)
    with pytest.raises(OSError, match="the disk broke"):
        await client.import_session(pieces)
    assert pieces.reads == 1
    with pytest.raises(OSError, match="the disk broke"):
        await client.import_session(aiter(pieces))
    assert await client.list_sessions() == ()


async def test_a_session_is_taken_up_although_its_caller_is_gone(
    archives: Exported, tmp_path: Path
) -> None:
    begun, told = asyncio.Event(), []

    async def on_stored(session: str) -> None:
        begun.set()
        await asyncio.sleep(0.05)
        told.append(session)

    with ThreadPoolExecutor(2) as threads:
        async with Store(tmp_path, threads) as store:
            known = Archives(store, threads=threads, limits=SubmapLimits())
            pieces = Pieces(archives.first)
            call = asyncio.ensure_future(known.import_(pieces, request_id="i", on_stored=on_stored))
            await begun.wait()
            call.cancel()
            with pytest.raises(asyncio.CancelledError):
                await call
            assert told == ["room"]
            info = await known.import_(pieces, request_id="i", on_stored=on_stored)
            assert (info.name, told) == ("sessions/room", ["room"])


def test_the_command_repeated_under_its_id_gets_the_first_answer(
    archives: Exported, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, folder = tmp_path / "room.tar", tmp_path / "store"
    file.write_bytes(archives.first)

    def imported(*options: str) -> tuple[int, dict]:
        place = ("--data-dir", str(folder), "--json")
        code = run_command(["sessions", "import", str(file), *place, *options])
        lines = capsys.readouterr().out.splitlines()
        return code, json.loads(lines[-1]) if code == 0 else {}

    first = imported("--request-id", "nightly")
    assert first[0] == 0
    assert first[1]["submap_count"] == 1
    assert imported("--request-id", "nightly") == first
    assert imported() == (1, {})
    assert imported("--request-id", "line\nbreak") == (2, {})
