"""`magic loops`: every candidate with its figures and its reason, from a folder or a server."""

from __future__ import annotations

import asyncio
import dataclasses
import json

import pytest

from magic_cli.loops import EXPLANATIONS
from magic_cli.main import run_command
from magic_core.evaluation import LoopRecord, RunFolder


def name(agent, index):
    return f"sessions/run/agents/{agent}/submaps/{index}"


def loop(source, target, similarity, verdict, *figures):
    return LoopRecord(name(*source), name(*target), similarity, verdict, *figures)


LOOPS = [
    loop(("agent_0", 1), ("agent_1", 2), 0.91, "accepted", "ACCEPTED", 0.8, 0.011, 60, 0.6),
    loop(("agent_0", 3), ("agent_1", 0), 0.84, "rejected", "LOW_OVERLAP", 0.7, 0.02, 12, 0.05),
    loop(("agent_1", 4), ("agent_1", 0), 0.95, "rejected", "FREE_SPACE", 0.5, 0.03, 30, 0.4),
    dataclasses.replace(
        loop(("agent_2", 0), ("agent_1", 1), 0.70, "rejected", "NO_HYPOTHESIS"),
        target_keyframe=7,
    ),
]


@pytest.fixture
def run(tmp_path):
    folder = RunFolder(tmp_path / "run").create()
    folder.write_loops(LOOPS)
    return str(folder.path)


def loops(capsys, *arguments):
    assert run_command(["loops", *arguments, "--json"]) == 0
    printed = capsys.readouterr()
    return json.loads(printed.out.strip().splitlines()[-1]), printed.err


def test_every_candidate_is_listed_with_figures_and_reason(run, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    answer, table = loops(capsys, run)
    assert answer["total"] == 4
    assert [c["similarity"] for c in answer["candidates"]] == [0.95, 0.91, 0.84, 0.70]
    first = next(c for c in answer["candidates"] if c["reason"] == "ACCEPTED")
    assert (first["overlap"], first["fitness"], first["rmse_m"]) == (0.6, 0.8, 0.011)
    last = answer["candidates"][-1]
    assert (last["source_keyframe"], last["target_keyframe"]) == (0, 7)
    for text in (
        "agent_1 1 @7",
        "agent_0 1",
        "0.910",
        "1.1 cm",
        "LOW_OVERLAP",
        "--registration.min-overlap",
    ):
        assert text in table


@pytest.mark.parametrize(
    ("options", "similarities"),
    [
        (["--verdict", "accepted"], [0.91]),
        (["--reason", "low_overlap"], [0.84]),
        (["--agent", "agent_0"], [0.91, 0.84]),
        (["--between"], [0.91, 0.84, 0.70]),
        (["--min-similarity", "0.9"], [0.95, 0.91]),
        (["--sort", "rmse"], [0.91, 0.84, 0.95, 0.70]),
        (["--sort", "overlap"], [0.91, 0.95, 0.84, 0.70]),
    ],
)
def test_filters_and_order(run, capsys, options, similarities):
    answer, _ = loops(capsys, run, *options)
    assert [c["similarity"] for c in answer["candidates"]] == similarities
    assert answer["total"] == 4


def test_every_reason_that_verification_gives_is_explained():
    import inspect
    import re

    from magic_server.registration import register, verify

    codes = set(re.findall(r'"([A-Z]+_[A-Z_]+|DEGENERATE|ACCEPTED)"', inspect.getsource(verify)))
    codes |= {register.ACCEPTED, register.NO_HYPOTHESIS}
    assert len(codes) > 7
    assert codes <= EXPLANATIONS.keys()


def test_a_folder_without_loops_is_a_clear_error(tmp_path, capsys):
    assert run_command(["loops", str(tmp_path)]) == 1
    assert "loops.json" in capsys.readouterr().err


def test_a_run_without_candidates_says_what_that_means(tmp_path, capsys):
    RunFolder(tmp_path).write_loops([])
    answer, text = loops(capsys, str(tmp_path))
    assert answer["candidates"] == []
    assert "--candidates.min-similarity" in text


async def test_a_live_server_is_asked_by_its_address(server, client, capsys):
    await client.register_agent("kitchen", "agent_0", model_id="model", dimension=4)
    command = ["loops", server.address, "--session", "kitchen", "--json"]
    assert await asyncio.to_thread(run_command, command) == 0
    answer = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert answer == {"total": 0, "reasons": {}, "candidates": []}
    command[3] = "nowhere"
    assert await asyncio.to_thread(run_command, command) == 1
    assert "nowhere" in capsys.readouterr().err
