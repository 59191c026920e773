"""A session as one archive: out of one server, into another, and nothing hostile gets in."""

from __future__ import annotations

import asyncio
import dataclasses
import hashlib
import io
import json
import tarfile
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import numpy as np
import pytest
import pytest_asyncio
from magicslam.v1 import archive_pb2

from magic_agent.client import ClientConfig, MagicClient
from magic_cli.main import run_command
from magic_core.errors import AlreadyExists, CorruptData, InvalidInput, MagicError, NotFound
from magic_core.submap import Descriptor
from magic_core.wire import records
from magic_server.config import ListenConfig, ServerConfig
from magic_server.jobs import JobConfig
from magic_server.loops import LoopConfig
from magic_server.server import Server
from magic_server.store_config import StoreConfig
from tests.postgresql import NewStore
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.stored import stored_files

pytestmark = pytest.mark.asyncio(loop_scope="module")

SUBMAPS = 4
SESSION = "sessions/room"


def name_of(index: int, agent: int = 0) -> str:
    return f"{SESSION}/agents/agent_{agent}/submaps/{index}"


def config_in(folder: Path, store: StoreConfig, jobs: JobConfig) -> ServerConfig:
    return ServerConfig(
        data_dir=folder,
        store=store,
        listen=ListenConfig(port=0, stop_grace_s=2.0),
        jobs=jobs,
        loops=LoopConfig(enabled=False),
    )


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def source(
    tmp_path_factory: pytest.TempPathFactory, new_store: NewStore, jobs: JobConfig
) -> AsyncIterator[MagicClient]:
    """A server whose session has two agents, a loop, a deleted sub-map and a merged map."""
    async with (
        Server(config_in(tmp_path_factory.mktemp("source"), new_store(), jobs)) as server,
        MagicClient(server.address, ClientConfig(rpc_timeout_s=60.0)) as client,
    ):
        for agent, count in ((0, SUBMAPS), (1, 1)):
            await client.register_agent(
                "room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION
            )
            for index in range(count):
                await client.submit_submap(
                    make_submap(agent=agent, index=index, submaps=SUBMAPS, described=agent == 1)
                )
        await client.finish_agent("room", "agent_0")
        coordinator = await server.sessions.named("room")
        assert await coordinator.idle(timeout_s=600)
        loop = records.LoopCandidate(
            name_of(3), name_of(0), 0.9, "PENDING", "PENDING", source_keyframe=1
        )
        await server._store.loops.add_candidates(coordinator.session, name_of(3), [loop])
        settled = dataclasses.replace(loop, verdict="REJECTED", reason="LOW_FITNESS", fitness=0.25)
        await server._store.loops.settle(coordinator.session, settled)
        await client.delete_submap(name_of(1))
        assert await coordinator.idle(timeout_s=600)
        await client.build_global_map("room", coarse_only=True)
        yield client


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def archive(source: MagicClient) -> bytes:
    """The archive of that session."""
    return b"".join([piece async for piece in source.export_session("room")])


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def target(
    tmp_path_factory: pytest.TempPathFactory, new_store: NewStore, jobs: JobConfig
) -> AsyncIterator[Server]:
    """Another server, empty; tests that store something delete it again."""
    async with Server(config_in(tmp_path_factory.mktemp("target"), new_store(), jobs)) as server:
        yield server


async def pieces(data: bytes, size: int = 70_000) -> AsyncIterator[bytes]:
    for begin in range(0, len(data), size):
        yield data[begin : begin + size]


def files_in(server: Server) -> list[str]:
    return stored_files(server.config)


async def assert_same(first: MagicClient, second: MagicClient) -> None:
    """Everything that a client can read of the session is the same on both."""
    assert await second.get_session("room") == await first.get_session("room")
    assert await second.list_agents("room") == await first.list_agents("room")
    submaps = await first.list_submaps("room")
    assert await second.list_submaps("room") == submaps
    for info in submaps:
        mine, other = [await client.download_encoded(info.name) for client in (first, second)]
        assert (mine.header, mine.blobs) == (other.header, other.blobs)
    assert (await first.list_loops("room")) == (await second.list_loops("room"))
    for agent in ("agent_0", "agent_1"):
        mine, other = [await client.get_trajectory("room", agent) for client in (first, second)]
        assert [part.submap for part in mine] == [part.submap for part in other]
        for a, b in zip(mine, other, strict=True):
            assert (a.revision, a.component) == (b.revision, b.component)
            for x, y in zip(a.frames, b.frames, strict=True):
                np.testing.assert_array_equal(x.world_from_camera, y.world_from_camera)
    mine, other = [
        (await client.download_global_map(SESSION, format="ply"))[1] for client in (first, second)
    ]
    assert mine == other


async def test_a_session_comes_back_whole_in_another_server(
    source: MagicClient, archive: bytes, target: Server
) -> None:
    async with MagicClient(target.address, ClientConfig(rpc_timeout_s=60.0)) as client:
        info = await client.import_session(pieces(archive))
        assert info == await source.get_session("room")
        assert await (await target.sessions.named("room")).idle(timeout_s=600)
        await assert_same(source, client)
        (loop,) = (await client.list_loops("room")).candidates
        assert (loop.source_keyframe, loop.target_keyframe) == (1, 0)
        keyframe = make_submap(agent=1, submaps=SUBMAPS, described=True).keyframes[1]
        assert keyframe.descriptor is not None
        descriptor = Descriptor(MODEL_ID, keyframe.descriptor)
        answer = await client.query_loops(descriptor, session="room", max_candidates=1)
        (found,) = answer.candidates
        assert (found.target, found.target_keyframe) == (name_of(0, agent=1), 1)
        again = b"".join([piece async for piece in client.export_session("room")])
        assert names_in(again) == names_in(archive)
        with pytest.raises(AlreadyExists, match="delete it before"):
            await client.import_session(pieces(archive))
        # Mapping goes on, over the sub-map that was deleted before the export.
        await client.register_agent("room", "agent_1", model_id=MODEL_ID, dimension=DIMENSION)
        await client.submit_submap(make_submap(agent=1, index=1, submaps=SUBMAPS))
        await client.delete_session("room", force=True)
    assert files_in(target) == []


async def test_an_archive_is_a_plain_tar_with_a_manifest_of_checksums(archive: bytes) -> None:
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        first, *rest = tar.getmembers()
        assert first.name == "manifest.json"
        manifest = json.loads(tar.extractfile(first).read())  # type: ignore[union-attr]
        assert (manifest["format"], manifest["version"]) == ("magicslam-session", 1)
        assert [member.name for member in rest] == [file["path"] for file in manifest["files"]]
        for member, file in zip(rest, manifest["files"], strict=True):
            data = tar.extractfile(member).read()  # type: ignore[union-attr]
            assert hashlib.sha256(data).hexdigest() == file["sha256"]
    assert rest[0].name == "session.pb"


async def test_the_command_moves_a_session_between_a_server_and_a_folder(
    source: MagicClient, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def magic(*arguments: str) -> tuple[int, dict]:
        code = run_command(["sessions", *arguments, "--json"])
        lines = capsys.readouterr().out.splitlines()
        return code, json.loads(lines[-1]) if lines else {}

    address, folder = ("--server", source.target), ("--data-dir", str(tmp_path / "store"))
    file = str(tmp_path / "room.tar")
    run = asyncio.to_thread  # the command has an event loop of its own
    code, listed = await run(magic, "list", *address)
    assert (code, [one["name"] for one in listed["sessions"]]) == (0, [SESSION])
    code, shown = await run(magic, "show", "room", *address)
    assert [agent["state"] for agent in shown["agents"]] == ["FINISHED", "ACTIVE"]
    assert (await run(magic, "export", "room", "--out", file, *address))[0] == 0
    assert (await run(magic, "export", "room", "--out", file, *address))[0] == 2
    assert (await run(magic, "list", *folder))[0] == 1
    code, imported = await run(magic, "import", file, *folder)
    assert (code, imported["submap_count"]) == (0, shown["submap_count"])
    async with Server(config_in(tmp_path / "store", StoreConfig(), JobConfig(workers=1))) as server:
        assert (await run(magic, "list", *folder))[0] == 1  # in use by a server
        async with MagicClient(server.address) as client:
            await assert_same(source, client)
    assert (await run(magic, "delete", "room", *folder))[0] == 1
    code, deleted = await run(magic, "delete", "room", "--force", *folder)
    assert (code, deleted["submaps"]) == (0, shown["submap_count"])
    assert (await run(magic, "list", *folder))[1] == {"sessions": []}


async def test_only_a_stored_session_can_be_exported(source: MagicClient) -> None:
    with pytest.raises(NotFound, match="sessions/hall"):
        await anext(source.export_session("hall"))


def names_in(data: bytes) -> list[str]:
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        return tar.getnames()


def rebuilt(data: bytes, change: Callable[[archive_pb2.SessionArchive, dict], None]) -> bytes:
    """The archive with another content, its manifest and checksums right."""
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        files = {m.name: tar.extractfile(m).read() for m in tar.getmembers()}  # type: ignore[union-attr]
    manifest = json.loads(files.pop("manifest.json"))
    message = archive_pb2.SessionArchive.FromString(files["session.pb"])
    change(message, files)
    files["session.pb"] = message.SerializeToString()
    manifest["files"] = [
        {"path": path, "length": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for path, content in files.items()
    ]
    return tar_of({"manifest.json": json.dumps(manifest).encode(), **files})


def tar_of(files: dict[str, bytes], **fields: object) -> bytes:
    """A tar of these files; `fields` are set in the header of the last."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for position, (path, content) in enumerate(files.items()):
            info = tarfile.TarInfo(path)
            info.size = len(content)
            if position == len(files) - 1:
                for field, value in fields.items():
                    setattr(info, field, value)
            tar.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def _stray(message: archive_pb2.SessionArchive, files: dict) -> None:
    files["blobs/" + hashlib.sha256(b"x").hexdigest()] = b"x"


def _climbing(message: archive_pb2.SessionArchive, files: dict) -> None:
    files["blobs/../../../etc/passwd"] = b"root"


def _missing(message: archive_pb2.SessionArchive, files: dict) -> None:
    del files[next(path for path in files if path.startswith("blobs/"))]


def _bad_blob(message: archive_pb2.SessionArchive, files: dict) -> None:
    info = message.submaps[0].header.blobs[0]
    del files[f"blobs/{info.sha256.hex()}"]
    info.sha256, info.length = hashlib.sha256(b"MGSC").digest(), 4
    files[f"blobs/{info.sha256.hex()}"] = b"MGSC"


def _nan(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.snapshot.poses[0].world_from_anchor.x = float("nan")


def _foreign_loop(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.loops[0].target = name_of(99)


def _no_such_keyframe(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.loops[0].target_keyframe = 2


def _bent_keyframe(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.submaps[0].header.keyframes[1].image_descriptor[:] = [1.0, 0.0]


def _climbing_session(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.session.name = "sessions/../../etc"


def _dangling(message: archive_pb2.SessionArchive, files: dict) -> None:
    del message.removed[:]


def _foreign_agent(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.agents[0].name = "sessions/hall/agents/agent_0"


def _far_time(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.submaps[0].received_at.seconds = 2**60


def _other_model(message: archive_pb2.SessionArchive, files: dict) -> None:
    message.session.descriptor_dimension = 3


def _empty_map(message: archive_pb2.SessionArchive, files: dict) -> None:
    del message.maps[0].map.submaps[:]


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (_stray, "blobs/"), (_climbing, "no place"), (_missing, "not in the archive"),
        (_bad_blob, "submaps[0]"), (_nan, "snapshot"), (_foreign_loop, "loops[0]"),
        (_climbing_session, "session"), (_dangling, "odometry"), (_foreign_agent, "agents[0]"),
        (_no_such_keyframe, "target_keyframe"), (_bent_keyframe, "keyframes[1].image_descriptor"),
        (_far_time, "submaps[0]"), (_other_model, "submaps[0]"), (_empty_map, "maps[0]"),
    ],
)  # fmt: skip
async def test_an_archive_with_wrong_content_is_refused_and_leaves_nothing(
    change: Callable, where: str, archive: bytes, target: Server
) -> None:
    error = await refusal(target, rebuilt(archive, change))
    assert where in str(error)


async def refusal(target: Server, data: bytes) -> MagicError:
    async with MagicClient(target.address) as client:
        with pytest.raises(MagicError) as caught:
            await client.import_session(pieces(data))
        assert isinstance(caught.value, (CorruptData, InvalidInput, MagicError))
        assert caught.value.grpc_code in ("DATA_LOSS", "INVALID_ARGUMENT", "FAILED_PRECONDITION")
        assert await client.list_sessions() == ()
    assert files_in(target) == []
    return caught.value


def _hostile(archive: bytes) -> dict[str, bytes]:
    """Archives that are no archives."""
    flipped = bytearray(archive)
    flipped[-5000] ^= 1
    manifest = json.dumps({"format": "magicslam-session", "version": 1, "files": []}).encode()
    large = [{"path": "session.pb", "length": 2**62, "sha256": "0" * 64}]
    huge = json.dumps({"format": "magicslam-session", "version": 1, "files": large}).encode()
    later = json.dumps({"format": "magicslam-session", "version": 9, "files": []}).encode()
    return {
        "nothing": b"\0" * 512,
        "noise": np.random.default_rng(0).bytes(100_000),
        "cut short": archive[: len(archive) // 2],
        "a flipped bit": bytes(flipped),
        "more behind its end": archive + b"more" * 512,
        "no session": tar_of({"manifest.json": manifest}),
        "a huge session": tar_of({"manifest.json": huge}),
        "a later version": tar_of({"manifest.json": later}),
        "a manifest that is no JSON": tar_of({"manifest.json": b"{" * 5000}),
        "a link": tar_of({"manifest.json": b"{}"}, type=tarfile.SYMTYPE, linkname="/etc/passwd"),
        "another first file": tar_of({"../../etc/passwd": b"root"}),
        "an extended header": tar_of({"manifest.json": b"{}"}, type=tarfile.XHDTYPE),
    }


@pytest.mark.parametrize("what", list(_hostile(b"\0" * 10_000)))
async def test_what_is_no_archive_is_refused_and_leaves_nothing(
    what: str, archive: bytes, target: Server
) -> None:
    await refusal(target, _hostile(archive)[what])
