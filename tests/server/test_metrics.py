"""What is counted, where it is read, and what the audit log says."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import http.client
import json
import logging
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from magicslam.v1 import session_service_pb2 as session_pb
from prometheus_client import CollectorRegistry, Counter
from prometheus_client.parser import text_string_to_metric_families

from magic_agent.client import ClientConfig, MagicClient
from magic_core import logs
from magic_core.errors import InvalidInput, NotFound, PermissionDenied, Unavailable
from magic_core.logs import LogConfig
from magic_core.wire import ClientCredentials
from magic_server.access import AccessConfig
from magic_server.audit import AuditConfig, AuditEntry, AuditLog
from magic_server.config import ServerConfig
from magic_server.native_log import handshake_reason
from magic_server.probes import MAX_READERS, MetricsConfig
from magic_server.server import Server
from tests.postgresql import scratch_of
from tests.small_world import DIMENSION, MODEL_ID, make_submap


@pytest.fixture
async def watched(server_config: ServerConfig) -> AsyncIterator[Server]:
    """A server with an HTTP port for metrics."""
    config = dataclasses.replace(server_config, metrics=MetricsConfig(port=0))
    async with Server(config) as running:
        yield running


async def get(server: Server, path: str) -> tuple[int, str]:
    """Status and body of a page."""

    def fetch() -> tuple[int, str]:
        try:
            url = f"http://{server.metrics_address}{path}"
            with urllib.request.urlopen(url, timeout=60) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    return await asyncio.to_thread(fetch)


async def scraped(server: Server) -> dict[str, float]:
    """Every sample, by name and labels."""
    status, text = await get(server, "/metrics")
    assert status == 200
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = ",".join(f"{k}={v}" for k, v in sorted(sample.labels.items()))
            found[f"{sample.name}{{{labels}}}" if labels else sample.name] = sample.value
    return found


async def register(client: MagicClient, agent: str = "agent_0") -> None:
    await client.register_agent("room", agent, model_id=MODEL_ID, dimension=DIMENSION)


async def test_calls_submaps_loops_jobs_and_refusals_are_counted(watched: Server) -> None:
    async with MagicClient(watched.address, ClientConfig(attempts=1)) as client:
        await register(client)
        await register(client, "agent_1")
        sizes = [
            (await client.submit_submap(make_submap(agent=agent))).stored_bytes for agent in (0, 1)
        ]
        assert (await client.submit_submap(make_submap(agent=0))).duplicate
        with pytest.raises(NotFound):
            await client.get_session("nowhere")
        with pytest.raises(InvalidInput):
            await client.get_session("..")
        coordinator = await watched.sessions.named("room")
        assert await coordinator.idle(600)
    found = await scraped(watched)
    assert found["magic_submaps_total"] == 2
    assert found["magic_submap_bytes_total"] == sum(sizes)
    assert found["magic_received_bytes_total"] == sum(sizes)
    assert found["magic_rpc_seconds_count{code=OK,method=SubmitSubmap}"] == 3
    assert found["magic_rpc_seconds_count{code=NOT_FOUND,method=GetSession}"] == 1
    assert found["magic_refusals_total{method=GetSession,reason=NOT_FOUND}"] == 1
    assert found["magic_refusals_total{method=GetSession,reason=INVALID_INPUT}"] == 1
    loops = {name: value for name, value in found.items() if name.startswith("magic_loops_total")}
    assert sum(loops.values()) == 1
    assert found["magic_jobs_total{outcome=ok,task=verify_loop}"] == 1
    assert found["magic_job_seconds_sum{task=solve_pose_graph}"] > 0
    for queue in ("search", "verify", "jobs", "calls", "watches", "uploads"):
        assert found[f"magic_queue_depth{{queue={queue}}}"] == 0
    assert found["magic_disk_free_bytes"] > 0
    assert found["magic_memory_free_bytes"] > 0
    assert found["process_resident_memory_bytes"] > 0


async def test_a_session_that_is_named_by_nobody_makes_no_label(watched: Server) -> None:
    async with MagicClient(watched.address, ClientConfig(attempts=1)) as client:
        for number in range(50):
            with pytest.raises(NotFound):
                await client.get_session(f"made-up-{number}")
    assert "made-up" not in (await get(watched, "/metrics"))[1]


async def test_readiness_is_not_liveness(watched: Server) -> None:
    assert await get(watched, "/readyz") == (200, "ready\n")
    watched.gate.drain()
    assert await get(watched, "/readyz") == (503, "not ready\n")
    assert await get(watched, "/livez") == (200, "alive\n")
    assert (await get(watched, "/secrets"))[0] == 404
    assert (await scraped(watched))["magic_ready"] == 0


async def test_a_slow_scraper_holds_up_nobody(watched: Server) -> None:
    host, _, port = str(watched.metrics_address).rpartition(":")
    _, slow = await asyncio.open_connection(host, int(port))
    slow.write(b"GET /metr")
    await slow.drain()
    assert (await get(watched, "/livez"))[0] == 200
    slow.close()


async def test_a_taken_metrics_port_is_named(watched: Server, tmp_path: Path) -> None:
    port = int(str(watched.metrics_address).rpartition(":")[2])
    config = dataclasses.replace(
        watched.config, data_dir=tmp_path / "other", metrics=MetricsConfig(port=port)
    )
    with pytest.raises(Unavailable, match=str(port)):
        async with Server(config):
            pass


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"CERTIFICATE_VERIFY_FAILED: certificate has expired", "CERTIFICATE_EXPIRED"),
        (b"CERTIFICATE_VERIFY_FAILED: self signed certificate", "CERTIFICATE_NOT_TRUSTED"),
        (b"PEER_DID_NOT_RETURN_A_CERTIFICATE: Invalid", "NO_CERTIFICATE"),
        (b"WRONG_VERSION_NUMBER: Invalid", "PLAINTEXT"),
        (b"something new", "HANDSHAKE_FAILED"),
    ],
)
def test_a_failed_handshake_has_a_reason(line: bytes, reason: str) -> None:
    assert handshake_reason(b"Handshake failed with error SSL_ERROR_SSL: " + line) == reason


# The audit log


async def test_every_mutation_is_in_the_audit_log_with_who_and_what(
    server_config: ServerConfig, tmp_path: Path
) -> None:
    (tmp_path / "tokens").write_text(
        "alice agent:sessions/room/agents/agent_0 alice-0123456789abcdef\n"
    )
    (tmp_path / "alice").write_text("alice-0123456789abcdef")
    config = dataclasses.replace(server_config, access=AccessConfig(tmp_path / "tokens"))
    credentials = ClientCredentials(token_file=tmp_path / "alice")
    async with Server(config) as server:
        client_config = ClientConfig(attempts=1, credentials=credentials)
        async with MagicClient(server.address, client_config) as client:
            await register(client)
            await client.submit_submap(make_submap(), request_id="first")
            await client.list_submaps("room")
            with pytest.raises(PermissionDenied):
                await client.delete_session("room")
    lines = (scratch_of(config) / "audit.jsonl").read_text().splitlines()
    entries = [json.loads(line) for line in lines]
    assert [entry["method"].rpartition("/")[2] for entry in entries] == [
        "RegisterAgent",
        "SubmitSubmap",
        "DeleteSession",
    ]
    assert {entry["principal"] for entry in entries} == {"alice"}
    assert [entry["code"] for entry in entries] == ["OK", "OK", "PERMISSION_DENIED"]
    assert entries[1]["resources"] == ["sessions/room/agents/agent_0/submaps/0"]
    assert entries[1]["request_id"] == "first"
    assert entries[2]["reason"] == "PERMISSION_DENIED"
    assert all(entry["peer"].startswith("ipv4:127.0.0.1") for entry in entries)
    assert "alice-0123" not in "".join(lines)


async def test_the_audit_log_is_put_aside_when_large_and_never_raises(tmp_path: Path) -> None:
    failures = Counter("failures", "x", registry=CollectorRegistry())
    entry = AuditEntry("ops", "ipv4:127.0.0.1:1", "/a/B", ("sessions/room",), "r", "OK")
    path = tmp_path / "audit.jsonl"
    log = AuditLog(AuditConfig(max_bytes=4096, keep=2), default=path, failures=failures)
    for _ in range(100):
        await log.write(entry)
    await log.close()
    sizes = {file.name: file.stat().st_size for file in tmp_path.iterdir()}  # noqa: ASYNC240
    assert set(sizes) == {"audit.jsonl", "audit.jsonl.1", "audit.jsonl.2"}
    assert max(sizes.values()) <= 4096
    broken = AuditLog(AuditConfig(), default=Path("/proc/no/audit.jsonl"), failures=failures)
    await broken.write(entry)
    await broken.close()
    assert failures._value.get() == 1


# Logs


def test_json_lines_carry_ids(capsys: pytest.CaptureFixture[str]) -> None:
    before = logging.getLogger().handlers[:]
    try:
        logs.configure(LogConfig(format="json"))
        with logs.bound(session="room", agent="agent_0"):
            logging.getLogger("magic.test").warning("%d loops\nand a line break", 3)
        try:
            raise ValueError("wrong")
        except ValueError:
            logging.getLogger("magic.test").exception("it broke")
    finally:
        logging.getLogger().handlers[:] = before
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    assert first["message"] == "3 loops\nand a line break"
    assert (first["session"], first["agent"], first["level"]) == ("room", "agent_0", "WARNING")
    assert "session" not in second
    assert "ValueError: wrong" in second["error"]


async def test_a_line_of_a_call_says_whom_it_is_about(
    server: Server, client: MagicClient, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[dict[str, str]] = []
    caplog.handler.addFilter(
        lambda record: logs._add_ids(record) and seen.append(record.ids) is None
    )
    with caplog.at_level(logging.INFO), pytest.raises(NotFound):
        await client.list_submaps("room", agent="agent_7")
    assert {"session": "room", "agent": "agent_7"} in seen


async def test_a_name_that_is_none_forges_no_log_line(
    server: Server, client: MagicClient, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.handler.addFilter(lambda record: logs._add_ids(record))
    caplog.handler.setFormatter(logs.TextFormatter())
    request = session_pb.GetAgentRequest(name="sessions/a\nmagic_server INFO forged/agents/b")
    with caplog.at_level(logging.INFO), pytest.raises(InvalidInput):
        await client.idempotent(client.session_stub.GetAgent, request)
    assert "forged" in caplog.text
    assert not any(line.startswith("magic_server INFO") for line in caplog.text.splitlines())


async def test_only_so_many_readers_of_metrics_are_answered(watched: Server) -> None:
    host, _, port = str(watched.metrics_address).rpartition(":")
    slow = [await asyncio.open_connection(host, int(port)) for _ in range(MAX_READERS)]
    with pytest.raises((urllib.error.URLError, OSError, http.client.HTTPException)):
        await get(watched, "/livez")
    for _, writer in slow:
        writer.close()
    async with asyncio.timeout(60):
        while True:
            with contextlib.suppress(urllib.error.URLError, OSError, http.client.HTTPException):
                assert (await get(watched, "/livez"))[0] == 200
                break
