"""An upload that breaks off goes on where it broke, also on a server that was started again."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import struct
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import grpc
import grpc.aio
import pytest
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc
from magicslam.v1 import submap_pb2 as submap_pb

from magic_agent.client import MagicClient
from magic_core.errors import (
    AlreadyExists,
    CorruptData,
    InvalidInput,
    MagicError,
    NotFound,
    Unavailable,
)
from magic_core.wire import EncodedSubmap, chunks_of, encode_submap, error_of
from magic_server.config import ServerConfig, ServiceLimits
from magic_server.server import Server
from magic_server.upload_config import PartialUploadLimits
from tests.postgresql import scratch_of
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import put_stray
from tests.waiting import eventually

CHUNK = 1000
NAME = "sessions/room/agents/agent_0/submaps/0"
Requests = list[mapping_pb.SubmitSubmapRequest]


@pytest.fixture
async def registered(client: MagicClient) -> MagicClient:
    """A client whose agent_0 is in session `room`."""
    await register(client)
    return client


async def register(client: MagicClient) -> None:
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)


def encoded(request_id: str = "first", index: int = 0) -> EncodedSubmap:
    return encode_submap(make_submap(index=index), request_id=request_id)


def messages(submap: EncodedSubmap, *, blob: int = 0, offset: int = 0) -> Requests:
    """Header and chunks from a position on."""
    found = [mapping_pb.SubmitSubmapRequest(header=submap.header)]
    for index in range(blob, len(submap.blobs)):
        begin = offset if index == blob else 0
        chunks = chunks_of(submap.blobs[index], blob_index=index, chunk_bytes=CHUNK, begin=begin)
        found += [mapping_pb.SubmitSubmapRequest(chunk=chunk) for chunk in chunks]
    return found


async def send(server: Server, sent: Requests, *, hold: bool = False) -> str:
    """Send raw messages; with `hold` the stream then stays open until the call is cancelled."""

    async def stream() -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
        for message in sent:
            yield message
        if hold:
            await asyncio.Event().wait()

    async with grpc.aio.insecure_channel(server.address) as channel:
        stub = mapping_grpc.MappingServiceStub(channel)
        try:
            return (await stub.SubmitSubmap(stream(), timeout=60)).submap
        except grpc.RpcError as failure:
            raise error_of(failure) from failure


def held_bytes(server: Server) -> int:
    """Bytes that lie in the folder of uploads, as the journals say, which are written last."""
    found = 0
    for folder in files_of_uploads(server):
        with contextlib.suppress(FileNotFoundError):  # gone since it was listed
            journal = (folder / "journal").read_bytes()
            records = struct.iter_unpack("<II", journal[: len(journal) // 8 * 8])
            found += sum(length for length, _ in records)
    return found


def files_of_uploads(server: Server) -> list[Path]:
    """What the folder of uploads holds."""
    return list((server._store.scratch / "uploads").iterdir())


def ends_blob(submap: EncodedSubmap, chunk: submap_pb.BlobChunk) -> bool:
    return chunk.offset + len(chunk.data) == len(submap.blobs[chunk.blob_index])


def payload(sent: Requests) -> int:
    return sum(len(message.chunk.data) for message in sent)


async def break_off(server: Server, sent: Requests) -> None:
    """Send some messages and then vanish, once the server has written them."""
    sending = asyncio.create_task(send(server, sent, hold=True))
    await eventually(lambda: held_bytes(server) == payload(sent))
    sending.cancel()
    await asyncio.gather(sending, return_exceptions=True)
    await eventually(lambda: server_kept(server)[1] == payload(sent))


def server_kept(server: Server) -> tuple[int, int]:
    return server._store.uploads.kept()


async def test_a_broken_stream_goes_on_behind_the_last_byte_that_came(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    sent = messages(submap)[:14]
    while ends_blob(submap, sent[-1].chunk):
        sent.pop()  # the position behind a whole blob is the start of the next
    await break_off(server, sent)
    position = await registered.resume_upload(NAME, "first")
    last = sent[-1].chunk
    assert (position.blob_index, position.offset) == (
        last.blob_index,
        last.offset + len(last.data),
    )
    assert position.durable_bytes == payload(sent)
    assert not position.stored
    assert await registered.list_submaps("room") == ()

    rest = messages(submap, blob=position.blob_index, offset=position.offset)
    assert payload(rest) + payload(sent) == sum(map(len, submap.blobs))
    assert await send(server, rest) == NAME
    found = await registered.download_encoded(NAME)
    assert (found.header, found.blobs) == (submap.header, submap.blobs)
    assert files_of_uploads(server) == []


async def test_a_server_that_was_killed_goes_on_with_what_had_come(
    server_config: ServerConfig,
) -> None:
    submap = encoded()
    sent = messages(submap)[:20]
    async with Server(server_config) as first, MagicClient(first.address) as client:
        await register(client)
        sending = asyncio.create_task(send(first, sent, hold=True))
        await eventually(lambda: held_bytes(first) == payload(sent))
        folder = scratch_of(server_config) / "uploads"
        # What a killed process leaves, before anything is tidied up.
        left = {file: file.read_bytes() for file in folder.glob("*/*")}
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)
    for file, data in left.items():
        file.write_bytes(data)
    async with Server(server_config) as second, MagicClient(second.address) as client:
        position = await client.resume_upload(NAME, "first")
        assert position.durable_bytes == payload(sent)
        receipt = await client.submit_encoded(submap, resume=True)
        assert not receipt.duplicate
        assert (await client.download_encoded(NAME)).blobs == submap.blobs


async def test_a_stream_that_breaks_in_an_unheard_of_way_leaves_what_came(
    registered: MagicClient, server: Server
) -> None:
    sent = messages(encoded())[:20]

    async def broken() -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
        for message in sent:
            yield message
        raise RuntimeError("the transport is gone")

    with pytest.raises(RuntimeError, match="the transport is gone"):
        await server._receiver.receive(broken(), on_stored=lambda agent, vertex: None)
    assert server_kept(server) == (1, payload(sent))
    position = await registered.resume_upload(NAME, "first")
    assert position.durable_bytes == payload(sent)


async def test_bytes_that_the_disk_lost_are_sent_again(server_config: ServerConfig) -> None:
    submap = encoded()
    sent = messages(submap)[:20]
    async with Server(server_config) as first, MagicClient(first.address) as client:
        await register(client)
        await break_off(first, sent)
    # As after a loss of power: the newest chunk is zeros, and another one is cut off.
    last = sent[-1].chunk
    blob = next((scratch_of(server_config) / "uploads").glob(f"*/{last.blob_index:05d}"))
    with blob.open("r+b") as file:
        file.seek(last.offset)
        file.write(bytes(len(last.data)))
    os.truncate(blob, blob.stat().st_size - 10)
    async with Server(server_config) as second, MagicClient(second.address) as client:
        position = await client.resume_upload(NAME, "first")
        assert position.durable_bytes == payload(sent[:-1])
        await client.submit_encoded(submap, resume=True)
        assert (await client.download_encoded(NAME)).blobs == submap.blobs


async def test_a_new_stream_takes_over_from_one_that_looks_alive(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    sent = messages(submap)[:10]
    stale = asyncio.create_task(send(server, sent, hold=True))
    await eventually(lambda: held_bytes(server) == payload(sent))
    receipt = await registered.submit_encoded(submap, resume=True)
    assert receipt.submap == NAME
    with pytest.raises(Unavailable, match="taken over"):
        await stale
    assert len(await registered.list_submaps("room")) == 1


async def test_a_stream_that_is_only_being_admitted_gives_way_too(
    server_config: ServerConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It must not be the silence that ends the stream.
    config = dataclasses.replace(server_config, limits=ServiceLimits(upload_idle_s=600.0))
    async with Server(config) as server, MagicClient(server.address) as client:
        await register(client)
        await _asked_for_while_being_admitted(client, server, monkeypatch)


async def _asked_for_while_being_admitted(
    client: MagicClient, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    receiver, entered, go = server._receiver, asyncio.Event(), asyncio.Event()
    admit = receiver._require_admission

    async def held(*given):
        entered.set()
        await go.wait()
        await admit(*given)

    monkeypatch.setattr(receiver, "_require_admission", held)
    stale = asyncio.create_task(send(server, messages(encoded())[:1], hold=True))
    await entered.wait()
    (claim,) = receiver._claims.values()
    asking = asyncio.create_task(client.resume_upload(NAME, "first"))
    await eventually(lambda: claim.gave_way)
    go.set()
    async with asyncio.timeout(120.0):
        assert (await asking).durable_bytes == 0
    with pytest.raises(Unavailable, match="taken over"):
        await stale


async def test_a_stream_that_ends_early_goes_on_where_it_ended(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    sent = messages(submap)[:10]
    with pytest.raises(InvalidInput, match=r"ended early.*ResumeUpload"):
        await send(server, sent)
    assert server_kept(server) == (1, payload(sent))
    position = await registered.resume_upload(NAME, "first")
    assert position.durable_bytes == payload(sent)
    rest = messages(submap, blob=position.blob_index, offset=position.offset)
    assert await send(server, rest) == NAME
    assert (await registered.download_encoded(NAME)).blobs == submap.blobs
    assert files_of_uploads(server) == []


def _wrong_checksum(chunk: submap_pb.BlobChunk) -> None:
    chunk.crc32 ^= 1


def _gap(chunk: submap_pb.BlobChunk) -> None:
    chunk.offset += 1


def _another_blob(chunk: submap_pb.BlobChunk) -> None:
    chunk.blob_index += 1


def _beyond_the_blob(chunk: submap_pb.BlobChunk) -> None:
    longer = next(chunks_of(bytes(900_000)))
    chunk.data, chunk.crc32 = longer.data, longer.crc32


def _empty(chunk: submap_pb.BlobChunk) -> None:
    chunk.data, chunk.crc32 = b"", 0


@pytest.mark.parametrize(
    ("damage", "kind"),
    [
        (_wrong_checksum, CorruptData),
        (_gap, InvalidInput),
        (_another_blob, InvalidInput),
        (_beyond_the_blob, InvalidInput),
        (_empty, InvalidInput),
    ],
)
async def test_a_stream_that_is_wrong_leaves_nothing_of_what_was_right(
    damage: Callable[[submap_pb.BlobChunk], None],
    kind: type[MagicError],
    registered: MagicClient,
    server: Server,
) -> None:
    submap = encoded()
    sent = messages(submap)[:10]
    damage(sent[-1].chunk)
    with pytest.raises(kind) as caught:
        await send(server, sent)
    assert type(caught.value) is kind
    assert server_kept(server) == (0, 0)
    assert files_of_uploads(server) == []
    assert (await registered.resume_upload(NAME, "first")).durable_bytes == 0
    assert await send(server, messages(submap)) == NAME


async def test_a_stream_from_the_beginning_starts_over(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    await break_off(server, messages(submap)[:10])
    assert await send(server, messages(submap)) == NAME
    assert (await registered.download_encoded(NAME)).blobs == submap.blobs


async def test_what_came_under_another_header_is_not_gone_on_with(
    registered: MagicClient, server: Server
) -> None:
    submap, other = encoded(), encoded()
    await break_off(server, messages(submap)[:10])
    other.header.trajectory[1].lost = not other.header.trajectory[1].lost
    with pytest.raises(InvalidInput, match="expected blob 0"):
        await send(server, messages(other, blob=0, offset=CHUNK))
    assert server_kept(server) == (0, 0)
    assert await send(server, messages(other)) == NAME


async def test_a_refusal_after_resuming_leaves_nothing(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    sent = messages(submap)
    await break_off(server, sent[:10])
    position = await registered.resume_upload(NAME, "first")
    rest = messages(submap, blob=position.blob_index, offset=position.offset)
    data = rest[-1].chunk.data
    changed = next(chunks_of(data[:-1] + bytes([data[-1] ^ 1])))
    rest[-1].chunk.data, rest[-1].chunk.crc32 = changed.data, changed.crc32
    with pytest.raises(MagicError, match="SHA-256"):
        await send(server, rest)
    assert files_of_uploads(server) == []
    assert (await registered.resume_upload(NAME, "first")).durable_bytes == 0


async def test_of_a_stored_submap_the_header_is_enough(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    first = await registered.submit_encoded(submap)
    position = await registered.resume_upload(NAME, "first")
    assert position.stored
    assert await send(server, messages(submap)[:1]) == NAME
    second = await registered.submit_encoded(submap, resume=True)
    assert second == dataclasses.replace(first, duplicate=True)
    with pytest.raises(AlreadyExists, match="another request"):
        await registered.resume_upload(NAME, "second")
    with pytest.raises(NotFound, match="agent_9"):
        await registered.resume_upload(NAME.replace("agent_0", "agent_9"), "first")


async def test_uploads_that_broke_off_are_bounded_and_expire(server_config: ServerConfig) -> None:
    kept = PartialUploadLimits(max_per_agent=2)
    limits = ServiceLimits(partial_uploads=kept)
    config = dataclasses.replace(server_config, limits=limits)
    submaps = [encoded(request_id=f"r{i}") for i in range(3)]
    async with Server(config) as server, MagicClient(server.address) as client:
        await register(client)
        for submap in submaps:
            sending = asyncio.create_task(send(server, messages(submap)[:8], hold=True))
            held = server_kept(server)
            await eventually(lambda h=held: held_bytes(server) > h[1])
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await eventually(lambda: not any(server._receiver._claims))
        assert server_kept(server)[0] == 2
        assert (await client.resume_upload(NAME, "r0")).durable_bytes == 0
        assert (await client.resume_upload(NAME, "r2")).durable_bytes > 0
    folder = scratch_of(config) / "uploads"
    assert len(list(folder.iterdir())) == 2
    yesterday = time.time() - 2 * kept.max_age_s
    for path in [*folder.glob("*/*"), *folder.iterdir()]:
        os.utime(path, (yesterday, yesterday))
    (folder / "stray").mkdir()
    async with Server(config):
        assert list(folder.iterdir()) == []


async def test_files_that_nothing_refers_to_are_collected_while_the_server_runs(
    server_config: ServerConfig,
) -> None:
    limits = ServiceLimits(upkeep_interval_s=0.1)
    config = dataclasses.replace(server_config, limits=limits)
    async with Server(config) as server, MagicClient(server.address) as client:
        await register(client)
        await client.submit_encoded(encoded())
        kept = set(server._store.blobs.names())
        put_stray(server._store.blobs, "ab" * 32, b"left by a transaction that failed")
        await eventually(lambda: set(server._store.blobs.names()) == kept)
        assert (await client.download_encoded(NAME)).blobs == encoded().blobs


async def test_streams_of_one_upload_that_chase_each_other_store_it_once(
    registered: MagicClient, server: Server
) -> None:
    submap = encoded()
    sent = messages(submap)

    async def chase(delay_s: float) -> None:
        await asyncio.sleep(delay_s)
        sending = asyncio.create_task(send(server, sent))
        await asyncio.sleep(0.004)
        sending.cancel()  # wherever it is: receiving, giving way, or committing
        await asyncio.gather(sending, return_exceptions=True)

    await asyncio.gather(*(chase(0.003 * i) for i in range(30)))
    receipt = await registered.submit_encoded(submap, resume=True)
    assert receipt.submap == NAME
    assert (await registered.download_encoded(NAME)).blobs == submap.blobs
    assert len(await registered.list_submaps("room")) == 1
