"""`magic doctor`: each check ends ok, warn or fail, with the remedy."""

from __future__ import annotations

import importlib.util
import json
import shutil
import socket
import sys
import time
import types

import llvmlite.binding as llvm
import psutil
import pytest

from magic_cli import machine
from magic_cli.main import run_command

EXPECTED = {"python", "cpu", "memory", "disk", "clock", "port", "page port", "kernel cache",
            "ffmpeg", "camera", "rerun", "libraries", "cuda", "descriptor model"}  # fmt: skip


def test_every_check_answers_on_this_machine(capsys, tmp_path):
    code = run_command(["doctor", "--json", "--folder", str(tmp_path), "--port", "1"])
    report = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    checks = {check["name"]: check for check in report["checks"]}
    assert checks.keys() == EXPECTED
    assert code == 0
    assert report["ok"]
    for check in checks.values():
        assert check["detail"]
        assert check["status"] == "ok" or check["remedy"]


def test_a_model_that_is_no_model_fails_with_its_path(tmp_path, capsys):
    (tmp_path / "bad.onnx").write_bytes(b"no model")
    code = run_command(["doctor", "--json", "--places-model", str(tmp_path / "bad.onnx")])
    report = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    failed = next(check for check in report["checks"] if check["status"] == "fail")
    assert (code, failed["name"]) == (1, "descriptor model")
    assert "bad.onnx" in failed["detail"]
    assert "--places-model" in failed["remedy"]


def test_a_taken_port_is_a_warning():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        found = machine.grpc_port(taken.getsockname()[1])
        page = machine.page_port(taken.getsockname()[1])
    assert found.status == "warn"
    assert "--port" in found.remedy
    assert page.status == "warn"
    assert "next free one" in page.remedy
    assert machine.grpc_port(700000).status == "warn"


def test_little_memory_is_told(monkeypatch):
    monkeypatch.setattr(
        psutil, "virtual_memory", lambda: types.SimpleNamespace(available=2_000_000_000)
    )
    found = machine.memory()
    assert found.status == "warn"
    assert "--scale" in found.remedy


def test_a_processor_without_vector_units_is_told(monkeypatch):
    monkeypatch.setattr(llvm, "get_host_cpu_features", lambda: {"sse2": True})
    assert machine.cpu().status == "warn"
    monkeypatch.setattr(llvm, "get_host_cpu_features", lambda: {"avx2": True})
    assert "8-lane" in machine.cpu().detail


def test_what_is_optional_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for check in (machine.rerun(), machine.camera()):
        assert check.status == "ok"
        assert "pip install" in check.detail


@pytest.mark.parametrize(("free_gb", "status"), [(0.5, "fail"), (3, "warn"), (50, "ok")])
def test_little_room_is_told(monkeypatch, tmp_path, free_gb, status):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=int(free_gb * 1e9)))
    found = machine.disk(tmp_path / "not" / "yet" / "there")
    assert found.status == status
    assert bool(found.remedy) == (status != "ok")


def test_a_clock_of_another_age_or_that_jumps_is_told(monkeypatch):
    assert machine.clock().status == "ok"
    old = time.struct_time((1970, 1, 1, 0, 0, 0, 3, 1, 0))
    with monkeypatch.context() as patched:
        patched.setattr(time, "gmtime", lambda *_: old)
        assert machine.clock().status == "fail"
    steps = iter((1000.0, 1003600.0))
    monkeypatch.setattr(time, "time", lambda: next(steps))
    found = machine.clock()
    assert found.status == "warn"
    assert "time service" in found.remedy


def test_a_kernel_cache_that_cannot_be_written_is_told(monkeypatch, tmp_path):
    from magic_core.render import jit

    monkeypatch.setattr(jit, "kernel_cache_folder", lambda: None)
    assert "MAGIC_KERNEL_CACHE" in machine.kernel_cache().remedy
    monkeypatch.setattr(jit, "kernel_cache_folder", lambda: tmp_path)
    found = machine.kernel_cache()
    assert (found.status, "--warm" in found.remedy) == ("warn", True)


def test_a_library_that_does_not_load_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    found = machine.libraries()
    assert found.status == "fail"
    assert "rosbags" in found.detail


def test_a_gpu_that_pytorch_cannot_use_is_told(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    found = machine.cuda()
    assert found.status == "warn"
    assert "magic-slam[cuda]" in found.remedy


def test_an_old_python_fails(monkeypatch):
    monkeypatch.setattr(machine, "OLDEST_PYTHON", (9, 0))
    assert machine.python().status == "fail"
