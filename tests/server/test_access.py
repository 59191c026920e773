"""Who may call: tokens, certificates and scopes; nobody writes as somebody else."""

from __future__ import annotations

import asyncio
import dataclasses
import hmac
import shutil
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

import grpc
import grpc.aio
import psutil
import pytest
from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import session_service_pb2 as session_pb

from magic_agent.client import ClientConfig, MagicClient
from magic_core.errors import (
    ConfigError,
    InvalidInput,
    PermissionDenied,
    PlaintextRefused,
    Unauthenticated,
    Unavailable,
)
from magic_core.wire import ClientCredentials, encode_submap, error_of
from magic_server import tokens
from magic_server.access import RULES, AccessConfig
from magic_server.config import ListenConfig, ServerConfig
from magic_server.server import Server
from magic_server.tls import TlsConfig
from magic_server.tokens import parse_tokens
from tests.certificates import Authority
from tests.small_world import DIMENSION, MODEL_ID, make_submap

REPOSITORY = Path(__file__).resolve().parents[2]
SECRET = "{}-0123456789abcdef"
TABLE = """
# name     scope                                secret
alice      agent:sessions/room/agents/agent_0   alice-0123456789abcdef
bob        agent:sessions/room/agents/agent_1   bob-0123456789abcdef
crew       agent:sessions/room                  crew-0123456789abcdef
viewer     reader:sessions/room                 viewer-0123456789abcdef
auditor    reader                               auditor-0123456789abcdef
ops        admin                                ops-0123456789abcdef
"""


@pytest.fixture
def secured(server_config: ServerConfig, tmp_path: Path) -> ServerConfig:
    """A server that knows the callers of TABLE, on loopback."""
    (tmp_path / "tokens").write_text(TABLE)
    return dataclasses.replace(server_config, access=AccessConfig(tmp_path / "tokens"))


@pytest.fixture
async def locked(secured: ServerConfig) -> AsyncIterator[Server]:
    async with Server(secured) as running:
        yield running


class Callers:
    """Clients of a server, one per caller."""

    def __init__(self, address: str, folder: Path) -> None:
        self._address = address
        self._folder = folder
        self._open: list[MagicClient] = []

    def __call__(self, name: str, token: str | None = None) -> MagicClient:
        file = self._folder / f"{name}.token"
        file.write_text(token or SECRET.format(name))
        credentials = ClientCredentials(token_file=file)
        client = MagicClient(self._address, ClientConfig(attempts=1, credentials=credentials))
        self._open.append(client)
        return client

    async def close(self) -> None:
        for client in self._open:
            await client.close()


@pytest.fixture
async def callers(locked: Server, tmp_path: Path) -> AsyncIterator[Callers]:
    made = Callers(locked.address, tmp_path)
    yield made
    await made.close()


async def register(client: MagicClient, agent: str = "agent_0", session: str = "room") -> None:
    await client.register_agent(session, agent, model_id=MODEL_ID, dimension=DIMENSION)


def test_every_call_has_a_rule() -> None:
    methods = {
        f"/{service.full_name}/{method.name}"
        for file in (mapping_pb, map_pb, session_pb)
        for service in file.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }
    ours = {method for method in RULES if method.startswith("/magicslam.")}
    assert methods == ours


def test_the_fields_of_every_rule_exist() -> None:
    for file in (mapping_pb, map_pb, session_pb):
        for service in file.DESCRIPTOR.services_by_name.values():
            for method in service.methods:
                for path in RULES[f"/{service.full_name}/{method.name}"].fields:
                    message = method.input_type
                    for part in path.split("."):
                        found = message.fields_by_name[part]
                        message = found.message_type


async def test_no_token_and_a_wrong_token_are_refused(locked: Server, callers: Callers) -> None:
    async with MagicClient(locked.address, ClientConfig(attempts=1)) as client:
        with pytest.raises(Unauthenticated, match="Bearer"):
            await client.list_sessions()
    with pytest.raises(Unauthenticated, match="not known"):
        await callers("ops", "ops-0123456789abcdeX").list_sessions()
    assert await callers("ops").list_sessions() == ()


async def test_an_agent_writes_as_itself_and_as_nobody_else(callers: Callers) -> None:
    alice, bob = callers("alice"), callers("bob")
    await register(alice)
    await register(bob, "agent_1")
    receipt = await alice.submit_submap(make_submap(agent=0))
    assert receipt.submap == "sessions/room/agents/agent_0/submaps/0"
    stolen = encode_submap(make_submap(agent=1), request_id="stolen")
    for attempt in (
        alice.submit_encoded(stolen),
        alice.finish_agent("room", "agent_1"),
        register(alice, "agent_1"),
        register(alice, "agent_0", "other"),
        alice.resume_upload(stolen.header.name, "stolen"),
        alice.delete_submap(receipt.submap),
        alice.start_global_map("room"),
    ):
        with pytest.raises(PermissionDenied, match="alice"):
            await attempt
    assert len(await alice.list_submaps("room")) == 1


async def test_a_crew_writes_as_every_agent_of_its_session_only(callers: Callers) -> None:
    crew = callers("crew")
    await register(crew, "agent_0")
    await register(crew, "agent_1")
    with pytest.raises(PermissionDenied):
        await register(crew, "agent_0", "elsewhere")
    with pytest.raises(PermissionDenied):
        await crew.delete_session("room")


async def test_a_reader_reads_its_session_and_writes_nothing(callers: Callers) -> None:
    await register(callers("ops"))
    await register(callers("ops"), session="other")
    viewer, auditor = callers("viewer"), callers("auditor")
    assert (await viewer.get_session("room")).agent_count == 1
    assert {s.name for s in await auditor.list_sessions()} == {"sessions/room", "sessions/other"}
    encoded = encode_submap(make_submap(), request_id="r")
    for attempt in (
        viewer.get_session("other"),
        viewer.list_sessions(),
        viewer.get_corrected_poses("other"),
        viewer.submit_encoded(encoded),
        auditor.submit_encoded(encoded),
        register(viewer),
        auditor.finish_agent("room", "agent_0"),
        auditor.start_global_map("room"),
        auditor.delete_agent("room", "agent_0"),
    ):
        with pytest.raises(PermissionDenied):
            await attempt


async def test_an_agent_may_be_asked_for_from_its_own_session_only(callers: Callers) -> None:
    ops, viewer = callers("ops"), callers("viewer")
    await register(ops)
    await register(ops, session="other")
    request = mapping_pb.GetCorrectedPosesRequest(
        session="sessions/room", agent="sessions/other/agents/agent_0"
    )
    with pytest.raises(grpc.RpcError) as caught:
        await viewer.mapping_stub.GetCorrectedPoses(request, timeout=60)
    assert caught.value.code() == grpc.StatusCode.PERMISSION_DENIED  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "name",
    [
        "sessions/../agents/agent_0",
        "sessions/room/agents/..",
        "sessions/room/agents/agent_0/../agent_1",
        "sessions/room/agents/agent_0%2f..%2fagent_1",
        "../../etc/passwd",
        "sessions/room\0/agents/agent_0",
        "/sessions/room/agents/agent_0",
        "sessions/ROOM/agents/" + "a" * 64,
    ],
)
async def test_path_tricks_are_no_names(callers: Callers, name: str, secured: ServerConfig) -> None:
    request = mapping_pb.RegisterAgentRequest(
        agent=name, request_id="r", descriptor_model_id=MODEL_ID, descriptor_dimension=DIMENSION
    )
    for caller in ("alice", "ops"):
        with pytest.raises((InvalidInput, PermissionDenied)) as caught:
            await callers(caller).idempotent(callers(caller).mapping_stub.RegisterAgent, request)
        assert caller == "alice" or isinstance(caught.value, InvalidInput)
    assert not list(secured.data_dir.glob("**/passwd"))


async def test_every_chunk_of_a_stream_belongs_to_the_authorised_header(
    locked: Server, callers: Callers
) -> None:
    await register(callers("ops"), "agent_0")
    await register(callers("ops"), "agent_1")
    mine = encode_submap(make_submap(agent=0), request_id="mine")
    theirs = encode_submap(make_submap(agent=1), request_id="theirs")

    async def stream() -> AsyncIterator[mapping_pb.SubmitSubmapRequest]:
        yield mapping_pb.SubmitSubmapRequest(header=mine.header)
        yield mapping_pb.SubmitSubmapRequest(header=theirs.header)

    with pytest.raises(grpc.RpcError) as caught:
        await callers("alice").mapping_stub.SubmitSubmap(stream(), timeout=60)
    assert isinstance(error_of(caught.value), PermissionDenied)


async def test_reflection_asks_for_a_token_and_health_does_not(locked: Server) -> None:
    from grpc_health.v1 import health_pb2, health_pb2_grpc
    from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

    async with grpc.aio.insecure_channel(locked.address) as channel:
        health = health_pb2_grpc.HealthStub(channel)
        answer = await health.Check(health_pb2.HealthCheckRequest(), timeout=60)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
        stub = reflection_pb2_grpc.ServerReflectionStub(channel)

        def listing(metadata=()):
            request = reflection_pb2.ServerReflectionRequest(list_services="")
            return stub.ServerReflectionInfo(iter([request]), timeout=60, metadata=metadata)

        with pytest.raises(grpc.RpcError) as caught:
            await anext(aiter(listing()))
        assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED  # type: ignore[attr-defined]
        token = ("authorization", "Bearer " + SECRET.format("auditor"))
        found = await anext(aiter(listing((token,))))
        names = {service.name for service in found.list_services_response.service}
        assert "magicslam.v1.MappingService" in names


async def test_callers_are_read_again_and_never_to_nobody(
    locked: Server, callers: Callers, tmp_path: Path
) -> None:
    file = tmp_path / "tokens"
    file.write_text(TABLE.replace("viewer-", "changed-"))
    assert locked.access.reload() == 6
    with pytest.raises(Unauthenticated):
        await callers("viewer").get_session("room")
    file.write_text("# all gone\n")
    with pytest.raises(InvalidInput, match="no callers are left"):
        locked.access.reload()
    file.write_text("ops admin short\n")
    with pytest.raises(ConfigError, match="can be guessed"):
        locked.access.reload()
    assert await callers("ops").list_sessions() == ()


def test_every_entry_is_compared_in_constant_time(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[int, int]] = []
    compare = hmac.compare_digest

    def counting(a: bytes, b: bytes) -> bool:
        compared.append((len(a), len(b)))
        return compare(a, b)

    monkeypatch.setattr(tokens.hmac, "compare_digest", counting)
    table = parse_tokens(TABLE, source="test")
    for token in (SECRET.format("alice"), SECRET.format("ops"), "wrong", ""):
        compared.clear()
        table.of_token(token)
        assert compared == [(32, 32)] * len(table)


def test_tokens_come_hashed_or_plain_and_from_the_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hashed = "ops admin sha256:" + tokens.hashlib.sha256(b"a-long-enough-token").hexdigest()
    monkeypatch.setenv("MAGIC_TOKENS", hashed)
    found = AccessConfig().load().of_token("a-long-enough-token")
    assert found is not None
    assert found.scope == "admin"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("ops admin", "2 words"),
        ("ops root 0123456789abcdef", "scope 'root'"),
        ("ops agent 0123456789abcdef", "scope 'agent'"),
        ("ops admin:sessions/room 0123456789abcdef", "scope"),
        ("ops agent:sessions/.. 0123456789abcdef", "not of the form"),
        ("ops admin tooshort", "can be guessed"),
        ("ops admin sha256:abc", "64 hexadecimal"),
        ("ops admin 0123456789abcdef\nops reader 0123456789abcdeg", "more than once"),
    ],
)
def test_a_wrong_line_is_named_and_its_secret_is_not(line: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        parse_tokens(line, source="tokens")
    assert "tooshort" not in str(caught.value)


async def test_a_token_does_not_leave_this_machine_in_the_open(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("0123456789abcdef")
    credentials = ClientCredentials(token_file=tmp_path / "token")
    with pytest.raises(ConfigError, match="unencrypted"):
        MagicClient("192.0.2.7:50051", ClientConfig(credentials=credentials))
    told = dataclasses.replace(credentials, insecure=True)
    await MagicClient("192.0.2.7:50051", ClientConfig(credentials=told)).close()


def own_address() -> str | None:
    """An address of this machine that is not loopback."""
    for addresses in psutil.net_if_addrs().values():
        for address in addresses:
            if address.family.name == "AF_INET" and not address.address.startswith("127."):
                return address.address
    return None


async def test_plaintext_from_another_machine_brings_no_token_in(
    secured: ServerConfig, tmp_path: Path
) -> None:
    host = own_address()
    if host is None:
        pytest.skip("this machine has no address but loopback")
    listen = ListenConfig(host="0.0.0.0", port=0, insecure=True)
    (tmp_path / "token").write_text(SECRET.format("ops"))
    credentials = ClientCredentials(token_file=tmp_path / "token", insecure=True)
    config = ClientConfig(attempts=1, credentials=credentials)
    async with Server(dataclasses.replace(secured, listen=listen)) as server:
        async with MagicClient(f"{host}:{server.port}", config) as client:
            with pytest.raises(PlaintextRefused, match="replace it"):
                await client.list_sessions()
        async with MagicClient(server.address, config) as client:
            assert await client.list_sessions() == ()
    access = dataclasses.replace(secured.access, insecure_tokens=True)
    told = dataclasses.replace(secured, listen=listen, access=access)
    async with Server(told) as server, MagicClient(f"{host}:{server.port}", config) as client:
        assert await client.list_sessions() == ()


async def test_tls_encrypts_and_takes_tokens(secured: ServerConfig, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    (tmp_path / "token").write_text(SECRET.format("ops"))
    credentials = dataclasses.replace(authority.client(), token_file=tmp_path / "token")
    async with Server(dataclasses.replace(secured, tls=authority.server())) as server:
        async with MagicClient(server.address, ClientConfig(credentials=credentials)) as client:
            assert await client.list_sessions() == ()
        stranger = Authority(tmp_path / "other").client()
        await assert_not_connected(server, stranger, "CERTIFICATE_VERIFY_FAILED")


async def assert_not_connected(server: Server, credentials: ClientCredentials, why: str) -> None:
    """A client does not get through; a machine that is slow needs longer to hear why."""
    said = ""
    for patience_s in (1.0, 5.0, 20.0):
        config = ClientConfig(credentials=credentials, connect_timeout_s=patience_s)
        with pytest.raises(Unavailable) as caught:
            async with MagicClient(server.address, config):
                pass
        said = str(caught.value)
        if why in said:
            return
    raise AssertionError(f"{why!r} is not in {said!r}")


async def test_a_certificate_is_a_caller(server_config: ServerConfig, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    lines = "robot agent:sessions/room/agents/agent_0 certificate:robot@example.org\n"
    (tmp_path / "tokens").write_text(lines)
    config = dataclasses.replace(
        server_config,
        tls=authority.server(mutual=True),
        access=AccessConfig(tmp_path / "tokens"),
    )
    async with Server(config) as server:
        robot = ClientConfig(attempts=1, credentials=authority.client("robot"))
        async with MagicClient(server.address, robot) as client:
            await register(client)
            with pytest.raises(PermissionDenied, match="robot"):
                await register(client, "agent_1")
        stranger = ClientConfig(attempts=1, credentials=authority.client("stranger"))
        async with MagicClient(server.address, stranger) as client:
            with pytest.raises(Unauthenticated):
                await register(client)
        for credentials in (authority.client(), authority.client("late", expired=True)):
            await assert_not_connected(server, credentials, "")


async def test_a_new_certificate_is_taken_up_without_a_restart(
    server_config: ServerConfig, tmp_path: Path
) -> None:
    authority = Authority(tmp_path / "ca")
    config = dataclasses.replace(server_config, tls=authority.server(expired=True))
    credentials = authority.client()
    async with Server(config) as server:
        await assert_not_connected(server, credentials, "certificate has expired")
        authority.server()
        client_config = ClientConfig(credentials=credentials, connect_timeout_s=60.0)
        async with MagicClient(server.address, client_config) as client:
            assert await client.list_sessions() == ()


async def test_the_certificates_of_the_script_work(
    server_config: ServerConfig, tmp_path: Path
) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    made = tmp_path / "certificates"
    script = REPOSITORY / "deploy" / "make-certificates"
    await asyncio.to_thread(
        subprocess.run, [script, made, "map.example", "robot_1"], check=True, capture_output=True
    )
    tls = TlsConfig(made / "server.pem", made / "server.key", made / "ca.pem")
    (tmp_path / "tokens").write_text("robot_1 agent:sessions/room certificate:robot_1\n")
    access = AccessConfig(tmp_path / "tokens")
    credentials = ClientCredentials(
        ca=made / "ca.pem",
        certificate=made / "robot_1.pem",
        key=made / "robot_1.key",
        server_name="map.example",
    )
    async with (
        Server(dataclasses.replace(server_config, tls=tls, access=access)) as server,
        MagicClient(server.address, ClientConfig(credentials=credentials)) as client,
    ):
        await register(client)
    assert (made / "server.key").stat().st_mode & 0o077 == 0


def test_tls_files_that_do_not_fit_are_named(server_config: ServerConfig, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    one, other = authority.issue("one"), authority.issue("other")
    with pytest.raises(ConfigError, match="belong together"):
        TlsConfig(certificate=one.certificate)
    from magic_server.tls import server_credentials

    with pytest.raises(ConfigError, match="do not fit"):
        server_credentials(TlsConfig(one.certificate, other.key))
    with pytest.raises(ConfigError, match="not PEM"):
        server_credentials(TlsConfig(Path(__file__), Path(__file__)))
    with pytest.raises(ConfigError, match="No such file"):
        server_credentials(TlsConfig(tmp_path / "no.pem", tmp_path / "no.key"))
