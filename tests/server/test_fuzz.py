"""Damaged messages are refused with a code that blames the caller (see `tests.faults.fuzz`)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import grpc
import grpc.aio
import pytest

from magic_core.errors import InvalidInput
from magic_core.wire import error_of
from magic_server.server import Server
from tests.faults.fuzz import check_all

REPOSITORY = Path(__file__).resolve().parents[2]


def test_every_check_refuses_damage_with_a_right_code(capsys: pytest.CaptureFixture[str]) -> None:
    result = check_all(1100, seed=5, start=0)
    assert result["wrong"] == []
    assert result["hangs"] == 0
    refused = sum(count for code, count in result["codes"].items() if not code.endswith(" OK"))
    assert refused > 550


@pytest.mark.parametrize("path", ["MappingService/GetCorrectedPoses", "SessionService/GetAgent"])
async def test_bytes_that_are_no_message_are_invalid_input(path: str, server: Server) -> None:
    async with grpc.aio.insecure_channel(server.address) as channel:
        call = channel.unary_unary(f"/magicslam.v1.{path}")
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await call(b"\x0a\xff\xff\xff\xff\x0f", timeout=60)
        assert type(error_of(caught.value)) is InvalidInput
        upload = channel.stream_unary("/magicslam.v1.MappingService/SubmitSubmap")
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await upload(iter([b"\x0a\xff\xff\xff\xff\x0f"]), timeout=60)
        assert type(error_of(caught.value)) is InvalidInput


@pytest.mark.slow
def test_a_live_server_survives_thousands_of_damaged_calls() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.faults.fuzz", "--messages", "20000", "--json"],
        cwd=REPOSITORY, capture_output=True, text=True, timeout=1500, check=False,
    )  # fmt: skip
    result = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 0, result["examples"]
    assert result["live_messages"] == 1000
