"""A live server under damaged calls: its RPCs, whole uploads, whole imports."""

from __future__ import annotations

import contextlib
import json
import random
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import psutil
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from magicslam.v1 import global_map_service_pb2, mapping_service_pb2, session_service_pb2

from magic_agent.client import ClientConfig, MagicClient
from magic_core.wire import chunks_of, images
from magic_server.config import ListenConfig, ServerConfig, ServiceLimits
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.quotas import QuotaConfig
from magic_server.server import Server
from tests.faults.fuzz_checks import LIMITS, Material, archive_file
from tests.faults.mutations import mutate_message, mutated_bytes, mutated_frame
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually

DEADLINE_S = 60.0
SAID_EVERY = 50
ALLOWED = frozenset(
    ("OK", "INVALID_ARGUMENT", "DATA_LOSS", "RESOURCE_EXHAUSTED", "NOT_FOUND",
     "FAILED_PRECONDITION", "ALREADY_EXISTS")
)  # fmt: skip
SKIPPED = ("WatchCorrectedPoses", "WaitOperation", "GetTrajectory", "BuildGlobalMap")
"""Left out: where a change left them right they wait by design, or start minutes of work."""


async def call_all(folder: Path, messages: int, seed: int, start: int) -> dict:
    """Send messages `start` to `messages`; prints each fiftieth number."""
    limits = ServiceLimits(submap=LIMITS, upload_idle_s=2.0)
    config = ServerConfig(
        data_dir=folder,
        listen=ListenConfig(port=0, stop_grace_s=1.0),
        limits=limits,
        jobs=JobConfig(workers=1, niceness=0),
        loops=LoopConfig(enabled=False),
        quotas=QuotaConfig(),
    )
    codes: Counter[str] = Counter()
    wrong: list[dict] = []
    async with Server(config) as server, MagicClient(server.address, ClientConfig()) as client:
        for session in ("fuzz", "other"):
            await client.register_agent(session, "agent_0", model_id=MODEL_ID, dimension=DIMENSION)
        await client.submit_submap(make_submap("fuzz"))
        async with grpc.aio.insecure_channel(server.address) as channel:
            callers = _callers(channel, Material.make())
            process, rss_warm, files_warm = psutil.Process(), 0, 0
            for number in range(start, messages):
                if number % SAID_EVERY == 0:
                    print(json.dumps({"at": number}), flush=True)
                name, call = callers[number % len(callers)]
                code, detail = await _code(call, random.Random(f"{seed}/live/{number}"))
                codes[f"{name} {code}"] += 1
                if code not in ALLOWED:
                    wrong.append({"kind": name, "number": number, "error": f"{code}: {detail}"})
                if number == start + int(0.3 * (messages - start)):
                    rss_warm, files_warm = process.memory_info().rss, process.num_fds()
            growth, files = process.memory_info().rss - rss_warm, process.num_fds() - files_warm
        strays = await _stray_files(client, folder)
    return {
        "codes": codes,
        "wrong": wrong,
        "hangs": codes.total() - _finished(codes),
        "rss_growth_bytes": growth,
        "open_files": files,
        "stray_files": len(strays),
    }


def _finished(codes: Counter[str]) -> int:
    return sum(count for code, count in codes.items() if not code.endswith("DEADLINE_EXCEEDED"))


async def _code(call: Any, rng: random.Random) -> tuple[str, str]:
    try:
        await call(rng)
    except grpc.aio.AioRpcError as error:
        return error.code().name, str(error.details())[:200]
    return "OK", ""


async def _stray_files(client: MagicClient, folder: Path) -> list[Path]:
    """Files that no stored sub-map refers to.

    Uploads that ended early wait to be gone on with, and go with their sessions.
    """
    wanted: set[str] = set()
    for session in await client.list_sessions():
        for info in await client.list_submaps(session.name.removeprefix("sessions/")):
            _, header = await client.get_submap(info.name)
            wanted |= {blob.sha256.hex() for blob in header.blobs}
    found = [file for file in (folder / "blobs").rglob("*") if file.is_file()]
    found = [file for file in found if file.name not in wanted]
    for session in await client.list_sessions():
        await client.delete_session(session.name.removeprefix("sessions/"), force=True)

    def unfinished() -> list[Path]:
        return [*(folder / "incoming").rglob("*"), *(folder / "uploads").rglob("*")]

    with contextlib.suppress(TimeoutError):  # some are tidied up behind their answer
        await eventually(lambda: not unfinished())
    return found + unfinished()


def _callers(channel: grpc.aio.Channel, material: Material) -> list[tuple[str, Any]]:
    """(name, coroutine of a random generator) for every RPC but those left out."""
    found: list[tuple[str, Any]] = []
    for file in (mapping_service_pb2, session_service_pb2, global_map_service_pb2):
        for service in file.DESCRIPTOR.services_by_name.values():
            for method in service.methods:
                if method.name in SKIPPED or method.client_streaming:
                    continue
                found.append((method.name, _unary(channel, service.full_name, method, material)))
    upload = f"/{mapping_service_pb2.DESCRIPTOR.package}.MappingService/SubmitSubmap"
    take = f"/{mapping_service_pb2.DESCRIPTOR.package}.SessionService/ImportSession"
    streams = [
        ("SubmitSubmap", _upload(channel, upload, material)),
        ("ImportSession", _import(channel, take, material)),
    ]
    return [*found, *streams * 4]


def _unary(channel: grpc.aio.Channel, service: str, method: Any, material: Material) -> Any:
    """Calls one method with a damaged request: its fields, or its bytes."""
    path = f"/{service}/{method.name}"
    right = _right_request(GetMessageClass(method.input_type)(), material)

    async def call(rng: random.Random) -> None:
        request = type(right).FromString(right.SerializeToString())
        mutate_message(request, rng)
        data = request.SerializeToString()
        if rng.random() < 0.3:
            data = mutated_bytes(data, rng)
        if method.server_streaming:
            async for _ in channel.unary_stream(path)(data, timeout=DEADLINE_S):
                pass
        else:
            await channel.unary_unary(path)(data, timeout=DEADLINE_S)

    return call


def _right_request(request: Message, material: Material) -> Message:
    """A request of its kind that the server would answer. Nothing that it names may be deleted."""
    header = material.zero.header
    values = {
        "session": "sessions/fuzz",
        "agent": "sessions/fuzz/agents/agent_0",
        "submap": header.name,
        "parent": "sessions/fuzz",
        "request_id": "again",
        "descriptor_model_id": MODEL_ID,
        "descriptor_dimension": DIMENSION,
        "name": _name_for(request),
        "colour": material.jpeg,
        "colour_media_type": images.JPEG,
        "depth_png": material.depth_png,
        "metres_per_unit": 0.001,
    }
    for field in request.DESCRIPTOR.fields:
        if field.name in values and not field.containing_oneof:
            setattr(request, field.name, values[field.name])
        elif field.name == "image_descriptor":
            request.image_descriptor.CopyFrom(header.image_descriptor)  # type: ignore[attr-defined]
        elif field.name == "camera":
            request.camera.CopyFrom(header.camera)  # type: ignore[attr-defined]
    return request


def _name_for(request: Message) -> str:
    kind = request.DESCRIPTOR.name
    for word, name in (
        ("Delete", "sessions/other/agents/none"),
        ("Operation", "sessions/fuzz/operations/1"),
        ("GlobalMap", "sessions/fuzz/maps/1"),
        ("Submap", "sessions/fuzz/agents/agent_0/submaps/0"),
        ("Agent", "sessions/fuzz/agents/agent_0"),
    ):
        if word in kind:
            return name
    return "sessions/fuzz"


def _upload(channel: grpc.aio.Channel, path: str, material: Material) -> Any:
    async def call(rng: random.Random) -> None:
        messages = [message.SerializeToString() for message in _damaged_upload(material, rng)]
        if rng.random() < 0.3:
            at = rng.randrange(len(messages))
            messages[at] = mutated_bytes(messages[at], rng)

        await channel.stream_unary(path)(_stream(messages), timeout=DEADLINE_S)

    return call


def _damaged(media_type: str, blob: bytes, rng: random.Random) -> bytes:
    if media_type == images.JPEG:
        return mutated_bytes(blob, rng)
    header_bytes = 16 if media_type == images.DEPTH_PLANES else 12
    return mutated_frame(blob, rng, header_bytes=header_bytes)


def _damaged_upload(material: Material, rng: random.Random) -> list[Any]:
    """The messages of an upload with one thing wrong; length and digest of a blob are right."""
    blobs = list(material.submap.blobs)
    header = material.header()
    header.name = f"sessions/fuzz/agents/agent_0/submaps/{rng.randrange(1, 9)}"
    header.request_id = f"fuzz {rng.random()}"
    if rng.random() < 0.4:
        at = rng.randrange(len(blobs))
        blobs[at] = _damaged(header.blobs[at].media_type, blobs[at], rng)
        _describe(header.blobs[at], blobs[at])
    elif rng.random() < 0.6:
        mutate_message(header, rng)
    request = mapping_service_pb2.SubmitSubmapRequest
    found = [request(header=header)]
    for index, blob in enumerate(blobs):
        for chunk in chunks_of(blob, blob_index=index, chunk_bytes=rng.choice((2000, 1 << 20))):
            found.append(request(chunk=chunk))
    match rng.randrange(5):
        case 0:
            del found[rng.randrange(len(found))]
        case 1:
            found.insert(rng.randrange(len(found)), rng.choice(found))
        case 2:
            mutate_message(rng.choice(found), rng)
    return found or [request()]


def _describe(info: Any, data: bytes) -> None:
    import hashlib

    info.length, info.sha256 = len(data), hashlib.sha256(data).digest()


def _import(channel: grpc.aio.Channel, path: str, material: Material) -> Any:
    async def call(rng: random.Random) -> None:
        archive = type(material.archive).FromString(material.archive.SerializeToString())
        mutate_message(archive, rng)  # the session exists, so that none of them may be stored
        data = archive_file(archive, material)
        if rng.random() < 0.5:
            data = mutated_bytes(data, rng)
        request = session_service_pb2.ImportSessionRequest
        requests = [request(chunk=chunk) for chunk in chunks_of(data)] or [request()]
        requests[0].request_id = f"{rng.random()}"
        messages = [one.SerializeToString() for one in requests]
        await channel.stream_unary(path)(_stream(messages), timeout=DEADLINE_S)

    return call


async def _stream(messages: list[bytes]) -> AsyncIterator[bytes]:
    for message in messages:
        yield message
