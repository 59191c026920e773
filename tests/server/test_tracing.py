"""One trace follows a sub-map from the agent through the server into the job that verifies it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from magic_agent.client import MagicClient
from magic_core import tracing
from magic_core.errors import ConfigError
from magic_core.tracing import TracingConfig
from magic_server.config import ServerConfig
from magic_server.server import Server
from tests.small_world import DIMENSION, MODEL_ID, make_submap
from tests.waiting import eventually


@pytest.fixture
def traced(tmp_path: Path) -> Iterator[TracingConfig]:
    """Tracing of this process, and of the workers it starts, into one file."""
    config = TracingConfig(exporter="file", path=tmp_path / "traces.jsonl")
    tracing.configure(config, service="test")
    yield config
    tracing.shut_down()


def spans(config: TracingConfig) -> list[dict]:
    if not config.path.exists():
        return []
    return [json.loads(line) for line in config.path.read_text().splitlines()]


async def test_one_trace_spans_agent_server_and_verification_job(
    server_config: ServerConfig, traced: TracingConfig
) -> None:
    if server_config.jobs.executor == "dask":
        pytest.skip("a worker of a cluster traces to where its own options say")
    config = dataclasses.replace(server_config, tracing=traced)
    async with Server(config) as server, MagicClient(server.address) as client:
        for agent in (0, 1):
            await client.register_agent(
                "room", f"agent_{agent}", model_id=MODEL_ID, dimension=DIMENSION
            )
            await client.submit_submap(make_submap(agent=agent))
        assert await (await server.sessions.named("room")).idle(600)
        # The worker sends its spans a moment after its job.
        await eventually(lambda: "worker verify_loop" in {span["name"] for span in spans(traced)})
    tracing.shut_down()
    found = spans(traced)
    by_id = {span["span_id"]: span for span in found}
    chain = [next(span for span in found if span["name"] == "worker verify_loop")]
    while chain[-1]["parent_id"] in by_id:
        chain.append(by_id[chain[-1]["parent_id"]])
    assert [span["name"] for span in reversed(chain)] == [
        "submit sub-map",
        "server SubmitSubmap",
        "verify loop",
        "job verify_loop",
        "worker verify_loop",
    ]
    assert len({span["trace_id"] for span in chain}) == 1
    assert chain[0]["pid"] != chain[1]["pid"]
    submitted, received = chain[-1], chain[-2]
    assert submitted["attributes"]["submap"] == "sessions/room/agents/agent_1/submaps/0"
    assert received["attributes"]["agent"] == "agent_1"
    trace = chain[0]["trace_id"]
    lines = (server._store.scratch / "audit.jsonl").read_text().splitlines()
    assert trace in {json.loads(line).get("trace_id") for line in lines}
    assert all(span["end_ns"] >= span["start_ns"] for span in found)


async def test_a_refusal_is_recorded_in_its_span(
    server_config: ServerConfig, traced: TracingConfig
) -> None:
    async with Server(server_config) as server, MagicClient(server.address) as client:
        with pytest.raises(Exception, match="does not exist"):
            await client.get_session("nowhere")
    tracing.shut_down()
    found = next(span for span in spans(traced) if span["name"] == "server GetSession")
    assert found["status"] == "ERROR"
    assert found["attributes"]["reason"] == "NOT_FOUND"


def test_a_traceparent_that_is_none_begins_a_trace(traced: TracingConfig) -> None:
    for parent in ("nonsense", "00-" + "0" * 32 + "-" + "0" * 16 + "-01", ""):
        with tracing.span("one", parent=parent):
            assert tracing.trace_id() != "0" * 32
            assert len(str(tracing.trace_id())) == 32


def test_nothing_happens_while_tracing_is_off() -> None:
    tracing.configure(TracingConfig(), service="test")
    with tracing.span("one", parent="nonsense", key="value"):
        tracing.annotate(other=1)
        assert tracing.traceparent() is None
        assert tracing.trace_id() is None


def test_a_wrong_ratio_is_named() -> None:
    with pytest.raises(ConfigError, match=r"tracing\.sample_ratio"):
        TracingConfig(sample_ratio=2.0)
