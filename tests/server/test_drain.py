"""A server that is told to stop finishes what it is receiving and takes nothing new."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import grpc
import grpc.aio
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import Unavailable
from magic_core.wire import chunks_of, encode_submap, error_of
from magic_server.config import ServerConfig
from magic_server.server import LIVENESS, READINESS, Server
from tests.faults.server_process import ServerForge, ServerProcess
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING


async def health(channel: grpc.aio.Channel, service: str) -> int:
    stub = health_pb2_grpc.HealthStub(channel)
    return (await stub.Check(health_pb2.HealthCheckRequest(service=service), timeout=60)).status


async def draining(channel: grpc.aio.Channel) -> None:
    """Wait until the server says that it is not ready."""
    watch = health_pb2_grpc.HealthStub(channel).Watch(
        health_pb2.HealthCheckRequest(service=READINESS), timeout=60
    )
    async for answer in watch:
        if answer.status == NOT_SERVING:
            break
    watch.cancel()


class SlowUpload:
    """A sub-map of which half is sent, and the rest when told."""

    def __init__(self, channel: grpc.aio.Channel) -> None:
        self._go_on = asyncio.Event()
        self.half_sent = asyncio.Event()
        stub = mapping_grpc.MappingServiceStub(channel)
        self.call = stub.SubmitSubmap(self._messages(), timeout=60)

    def go_on(self) -> None:
        self._go_on.set()

    async def _messages(self) -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
        encoded = encode_submap(make_submap(), request_id="slow")
        yield mapping_pb.SubmitSubmapRequest(header=encoded.header)
        for index, blob in enumerate(encoded.blobs):
            for chunk in chunks_of(blob, blob_index=index, chunk_bytes=4000):
                yield mapping_pb.SubmitSubmapRequest(chunk=chunk)
                if chunk.offset == 0 and index == 1:
                    self.half_sent.set()
                    await self._go_on.wait()


async def begun(address: str) -> tuple[grpc.aio.Channel, SlowUpload]:
    """A registered agent with an upload under way."""
    async with MagicClient(address) as client:
        await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    channel = grpc.aio.insecure_channel(address)
    upload = SlowUpload(channel)
    await upload.half_sent.wait()
    assert await health(channel, READINESS) == SERVING
    return channel, upload


async def test_one_sigterm_drains_and_a_second_ends_at_once(
    tmp_path: Path, server_config: ServerConfig
) -> None:
    async with ServerForge() as forge:
        drained, ended = tmp_path / "drained", tmp_path / "ended"
        # Time enough to finish what is sent, however slowly: only the second signal cuts it.
        await drains(await forge.start({"data_dir": str(drained), "stop_grace_s": 600.0}))
        await ends_at_once(await forge.start({"data_dir": str(ended), "stop_grace_s": 600.0}))
    again = ServerConfig(data_dir=drained, listen=server_config.listen, jobs=server_config.jobs)
    async with Server(again) as server, MagicClient(server.address, ClientConfig()) as client:
        stored = [info.name for info in await client.list_submaps("room")]
    assert stored == ["sessions/room/agents/agent_0/submaps/0"]


async def drains(process: ServerProcess) -> None:
    """The upload under way is acknowledged, new calls are refused, the exit code is 0."""
    address = await process.ready()
    channel, upload = await begun(address)
    os.kill(process.pid, signal.SIGTERM)
    await draining(channel)
    assert await health(channel, LIVENESS) == SERVING
    assert await health(channel, "") == NOT_SERVING
    assert await health(channel, "magicslam.v1.MappingService") == NOT_SERVING
    with pytest.raises(grpc.RpcError) as caught:
        await session_grpc.SessionServiceStub(channel).ListSessions(
            session_pb.ListSessionsRequest(), timeout=60
        )
    refusal = error_of(caught.value)
    assert isinstance(refusal, Unavailable)
    assert "stopping" in refusal.message
    assert refusal.retry_after_s
    upload.go_on()
    answer = await upload.call
    assert answer.submap == "sessions/room/agents/agent_0/submaps/0"
    assert await process.end(signal.Signals.SIGCONT) == 0
    await channel.close()


async def ends_at_once(process: ServerProcess) -> None:
    """The upload under way is cut, as a kill would."""
    channel, upload = await begun(await process.ready())
    os.kill(process.pid, signal.SIGTERM)
    await draining(channel)
    os.kill(process.pid, signal.SIGTERM)
    status = await process.end(signal.Signals.SIGCONT)
    assert os.waitstatus_to_exitcode(status) == 128 + signal.SIGTERM
    upload.call.cancel()
    await channel.close()


async def test_health_answers_and_calls_are_refused_while_the_store_is_opened(
    server_config: ServerConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = Server(server_config)
    loading = asyncio.Event()
    start_sessions = server.sessions.start

    async def slowly(**settings: bool) -> None:
        await loading.wait()
        await start_sessions(**settings)

    monkeypatch.setattr(server.sessions, "start", slowly)
    starting = asyncio.create_task(server.start())
    await eventually(lambda: server._grpc is not None)
    async with grpc.aio.insecure_channel(server.address) as channel:
        assert await health(channel, LIVENESS) == SERVING
        assert await health(channel, READINESS) == NOT_SERVING
        async with MagicClient(server.address, ClientConfig(attempts=1)) as client:
            with pytest.raises(Unavailable, match="starting"):
                await client.list_sessions()
            loading.set()
            await starting
            assert await health(channel, READINESS) == SERVING
            assert await client.list_sessions() == ()
    await server.stop()
