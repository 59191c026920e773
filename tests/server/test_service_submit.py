"""SubmitSubmap: what is acknowledged is stored, what is refused leaves nothing behind."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator, Callable

import grpc
import grpc.aio
import numpy as np
import pytest
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc

from magic_agent.client import MagicClient
from magic_core.errors import (
    AlreadyExists,
    CorruptData,
    DescriptorModelMismatch,
    InvalidInput,
    MagicError,
    NotFound,
    ResourceExhausted,
    WrongState,
)
from magic_core.gaussians import GaussianCloud, codec
from magic_core.wire import EncodedSubmap, SubmapLimits, chunks_of, encode_submap, error_of
from magic_core.wire.chunks import sha256
from magic_server.config import ServerConfig, ServiceLimits
from magic_server.server import Server
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_files
from tests.waiting import eventually


@pytest.fixture
async def registered(client: MagicClient) -> MagicClient:
    """A client whose agent_0 is in session `room`."""
    await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
    return client


def encoded(index: int = 0, request_id: str = "first") -> EncodedSubmap:
    """A sub-map's bytes, free to be changed."""
    made = encode_submap(make_submap(index=index), request_id=request_id)
    header = type(made.header).FromString(made.header.SerializeToString())
    return EncodedSubmap(header, made.blobs)


def with_blob(submap: EncodedSubmap, index: int, data: bytes) -> EncodedSubmap:
    """The same sub-map with another blob, length and digest right."""
    submap.header.blobs[index].length = len(data)
    submap.header.blobs[index].sha256 = sha256(data)
    blobs = list(submap.blobs)
    blobs[index] = data
    return EncodedSubmap(submap.header, tuple(blobs))


def messages(submap: EncodedSubmap) -> list[mapping_pb.SubmitSubmapRequest]:
    """What a client sends."""
    found = [mapping_pb.SubmitSubmapRequest(header=submap.header)]
    for index, blob in enumerate(submap.blobs):
        chunks = chunks_of(blob, blob_index=index, chunk_bytes=1000)
        found += [mapping_pb.SubmitSubmapRequest(chunk=chunk) for chunk in chunks]
    return found


async def send(server: Server, sent: list[mapping_pb.SubmitSubmapRequest]) -> str:
    """Send raw messages; raises the error the server answers with."""

    async def stream() -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
        for message in sent:
            yield message

    async with grpc.aio.insecure_channel(server.address) as channel:
        stub = mapping_grpc.MappingServiceStub(channel)
        try:
            return (await stub.SubmitSubmap(stream(), timeout=60)).submap
        except grpc.RpcError as failure:
            raise error_of(failure) from failure


def files_in(server: Server) -> list[str]:
    """Every stored file, finished or not."""
    return stored_files(server.config)


async def assert_nothing_is_left(server: Server, client: MagicClient) -> None:
    assert files_in(server) == []
    assert await client.list_submaps("room") == ()


async def test_what_is_acknowledged_comes_back_byte_for_byte(
    registered: MagicClient, server: Server
) -> None:
    sent = encode_submap(make_submap(), request_id="first")
    receipt = await registered.submit_encoded(sent)
    assert receipt.submap == "sessions/room/agents/agent_0/submaps/0"
    assert receipt.stored_bytes == sum(map(len, sent.blobs))
    assert receipt.wire_bytes == sent.wire_bytes
    assert not receipt.duplicate
    stored = await registered.download_encoded(receipt.submap)
    assert stored.header == sent.header
    assert stored.blobs == sent.blobs
    assert files_in(server) == sorted({sha256(blob).hex() for blob in sent.blobs})


async def test_a_repeat_gets_the_first_answer_and_stores_nothing(registered: MagicClient) -> None:
    first = await registered.submit_submap(make_submap())
    second = await registered.submit_submap(make_submap())
    assert second.duplicate
    assert second == dataclasses.replace(first, duplicate=True)
    assert len(await registered.list_submaps("room")) == 1


async def test_concurrent_repeats_store_one_submap(registered: MagicClient, server: Server) -> None:
    receipts = await asyncio.gather(*(registered.submit_submap(make_submap()) for _ in range(5)))
    assert sum(not receipt.duplicate for receipt in receipts) == 1
    assert len({receipt.received_at for receipt in receipts}) == 1
    assert len(await registered.list_submaps("room")) == 1
    blobs = encode_submap(make_submap(), request_id="r").blobs
    assert files_in(server) == sorted({sha256(blob).hex() for blob in blobs})


async def test_a_request_id_brings_one_submap(registered: MagicClient, server: Server) -> None:
    await registered.submit_submap(make_submap(), request_id="first")
    with pytest.raises(AlreadyExists, match=r"request .first. stored .*submaps/0"):
        await registered.submit_submap(make_submap(index=1), request_id="first")
    assert len(await registered.list_submaps("room")) == 1
    assert list((server._store.scratch / "uploads").iterdir()) == []


async def test_another_request_for_a_stored_submap_is_refused(registered: MagicClient) -> None:
    await registered.submit_submap(make_submap(), request_id="first")
    with pytest.raises(AlreadyExists):
        await registered.submit_submap(make_submap(), request_id="second")
    with pytest.raises(AlreadyExists, match="other content"):
        await registered.submit_submap(make_submap(), request_id="first", lossless=True)


async def test_an_unknown_agent_or_session_is_not_found(
    registered: MagicClient, server: Server
) -> None:
    with pytest.raises(NotFound, match="agent_1"):
        await registered.submit_submap(make_submap(agent=1))
    with pytest.raises(NotFound, match="sessions/hall"):
        await registered.submit_submap(make_submap("hall"))
    await assert_nothing_is_left(server, registered)


async def test_a_finished_agent_may_not_submit_but_may_repeat(registered: MagicClient) -> None:
    await registered.submit_submap(make_submap())
    assert await registered.finish_agent("room", "agent_0") == 1
    with pytest.raises(WrongState, match="finished"):
        await registered.submit_submap(make_submap(index=1))
    assert (await registered.submit_submap(make_submap())).duplicate


async def test_odometry_to_a_submap_that_is_not_stored_is_refused(registered: MagicClient) -> None:
    with pytest.raises(WrongState, match="submaps/0, which is not stored"):
        await registered.submit_submap(make_submap(index=1))


async def test_a_descriptor_of_another_model_is_refused(
    registered: MagicClient, server: Server
) -> None:
    bad = encoded()
    bad.header.image_descriptor.model_id = "another-model"
    with pytest.raises(DescriptorModelMismatch, match=f"{MODEL_ID}.*another-model"):
        await registered.submit_encoded(bad)
    await assert_nothing_is_left(server, registered)


def _gaussians(change: Callable[[list[np.ndarray]], None]) -> bytes:
    arrays = [array.copy() for array in make_submap().gaussians.arrays()]
    change(arrays)
    return codec.encode_lossless(GaussianCloud(*arrays))


def _nan_mean(arrays: list[np.ndarray]) -> None:
    arrays[0][5, 1] = np.nan


def _long_quaternion(arrays: list[np.ndarray]) -> None:
    arrays[1][5] *= 1.5


def _negative_scale(arrays: list[np.ndarray]) -> None:
    arrays[2][5, 0] = -0.1


def _wrong_camera() -> EncodedSubmap:
    bad = encoded()
    bad.header.camera.width += 1
    return bad


def _nan_pose() -> EncodedSubmap:
    bad = encoded()
    bad.header.trajectory[1].anchor_from_camera.y = float("nan")
    return bad


def _short_information() -> EncodedSubmap:
    bad = encoded()
    bad.header.odometry.information.extend([1.0] * 20)
    return bad


MALFORMED: dict[str, tuple[Callable[[], EncodedSubmap], type[MagicError], str]] = {
    "Gaussians with NaN": (
        lambda: with_blob(encoded(), 0, _gaussians(_nan_mean)), InvalidInput, "blobs[0]"),
    "Gaussians with a non-unit quaternion": (
        lambda: with_blob(encoded(), 0, _gaussians(_long_quaternion)), InvalidInput, "blobs[0]"),
    "Gaussians with a negative scale": (
        lambda: with_blob(encoded(), 0, _gaussians(_negative_scale)), InvalidInput, "blobs[0]"),
    "Gaussians cut short": (
        lambda: with_blob(encoded(), 0, encoded().blobs[0][:-9]), CorruptData, ""),
    "images of another size": (_wrong_camera, InvalidInput, "blobs[1]"),
    "a depth image for a colour image": (
        lambda: with_blob(encoded(), 1, encoded().blobs[2]), CorruptData, ""),
    "a pose with NaN": (_nan_pose, InvalidInput, "trajectory[1].anchor_from_camera"),
    "an information matrix of 20 numbers": (
        _short_information, InvalidInput, "odometry.information"),
}  # fmt: skip


@pytest.mark.parametrize("what", MALFORMED)
async def test_a_malformed_submap_is_refused_and_leaves_nothing(
    what: str, registered: MagicClient, server: Server
) -> None:
    make, kind, field = MALFORMED[what]
    with pytest.raises(kind) as caught:
        await registered.submit_encoded(make())
    assert type(caught.value) is kind
    if field:
        assert field in [violation.field for violation in caught.value.violations]
    await assert_nothing_is_left(server, registered)
    await registered.submit_submap(make_submap())  # the right one is welcome afterwards


def _flip(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    data = sent[-1].chunk.data
    sent[-1].chunk.data = data[:-1] + bytes([data[-1] ^ 1])


def _flip_with_matching_crc(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    data = sent[-1].chunk.data
    changed = next(chunks_of(data[:-1] + bytes([data[-1] ^ 1])))
    sent[-1].chunk.data, sent[-1].chunk.crc32 = changed.data, changed.crc32


def _end_early(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    del sent[-1]


def _swap(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    sent[1], sent[2] = sent[2], sent[1]


def _skip(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    del sent[2]


def _append(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    sent.append(sent[-1])


def _second_header(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    sent[1] = sent[0]


def _no_header(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    del sent[0]


def _nothing(sent: list[mapping_pb.SubmitSubmapRequest]) -> None:
    sent.clear()


@pytest.mark.parametrize(
    ("damage", "kind"),
    [
        (_flip, CorruptData),
        (_flip_with_matching_crc, CorruptData),
        (_end_early, InvalidInput),
        (_swap, InvalidInput),
        (_skip, InvalidInput),
        (_append, InvalidInput),
        (_second_header, InvalidInput),
        (_no_header, InvalidInput),
        (_nothing, InvalidInput),
    ],
)
async def test_a_damaged_upload_is_refused_and_leaves_nothing(
    damage: Callable[[list[mapping_pb.SubmitSubmapRequest]], None],
    kind: type[MagicError],
    registered: MagicClient,
    server: Server,
) -> None:
    sent = messages(encoded())
    damage(sent)
    with pytest.raises(kind) as caught:
        await send(server, sent)
    assert type(caught.value) is kind
    await assert_nothing_is_left(server, registered)


async def test_a_client_that_goes_away_leaves_nothing_but_what_it_can_go_on_with(
    registered: MagicClient, server: Server
) -> None:
    sent = messages(encoded())
    half = asyncio.Event()

    async def stream() -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
        for message in sent[: len(sent) // 2]:
            yield message
        half.set()
        await asyncio.Event().wait()

    async with grpc.aio.insecure_channel(server.address) as channel:
        call = mapping_grpc.MappingServiceStub(channel).SubmitSubmap(stream())
        await half.wait()
        await eventually(lambda: any((server._store.scratch / "uploads").iterdir()))
        call.cancel()
    await assert_nothing_is_left(server, registered)
    await registered.submit_encoded(encoded())
    assert list((server._store.scratch / "uploads").iterdir()) == []


async def test_a_submap_beyond_the_servers_limit_is_refused(
    server_config: ServerConfig,
) -> None:
    limits = ServiceLimits(submap=SubmapLimits(max_bytes=1000))
    async with (
        Server(dataclasses.replace(server_config, limits=limits)) as server,
        MagicClient(server.address) as client,
    ):
        answer = await client.register_agent(
            "room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION
        )
        assert answer.max_submap_bytes == 1000
        with pytest.raises(ResourceExhausted, match="1000"):
            await client.submit_submap(make_submap())
        await assert_nothing_is_left(server, client)


async def test_an_upload_that_stops_talking_is_ended(server_config: ServerConfig) -> None:
    limits = ServiceLimits(upload_idle_s=0.2)
    async with (
        Server(dataclasses.replace(server_config, limits=limits)) as server,
        MagicClient(server.address) as client,
    ):
        await client.register_agent("room", "agent_0", model_id=MODEL_ID, dimension=DIMENSION)

        async def stream() -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
            yield messages(encoded())[0]
            await asyncio.Event().wait()

        async with grpc.aio.insecure_channel(server.address) as channel:
            with pytest.raises(grpc.RpcError) as caught:
                await mapping_grpc.MappingServiceStub(channel).SubmitSubmap(stream(), timeout=60)
        assert "no message for 0.2 s" in str(error_of(caught.value))
        await assert_nothing_is_left(server, client)
