"""How many float32 lanes the kernels use: 16 with AVX-512, else 8 (AVX2, NEON-class).

Sixteen lanes on a machine with sixteen 256-bit registers spill in every inner loop (the backward
blend took 4.5 times as long), so the number is chosen before anything is compiled, from the
processor that numba will compile for: `NUMBA_CPU_NAME` and `NUMBA_CPU_FEATURES` count.
`MAGIC_LANES=8` forces the narrow path.
"""

from __future__ import annotations

import os
from typing import Any

import llvmlite.binding as llvm
from numba.core import config as _numba_config

config: Any = _numba_config  # its settings are attributes made at run time

_NEEDED_BY_16 = ("avx512f", "avx512bw", "avx512dq", "avx512vl")


def choose_lanes() -> int:
    """16 where numba's target has the AVX-512 subset that the wide path needs, else 8."""
    forced = os.environ.get("MAGIC_LANES")
    if forced:
        if forced not in ("8", "16"):
            raise ValueError(f"MAGIC_LANES={forced}: expected 8 or 16")
        return int(forced)
    enabled = {name[1:] for name in _target_features().split(",") if name.startswith("+")}
    return 16 if all(name in enabled for name in _NEEDED_BY_16) else 8


def _target_features() -> str:
    if config.CPU_FEATURES is not None:
        return config.CPU_FEATURES
    if config.CPU_NAME not in (None, "host") and llvm.get_host_cpu_name() != config.CPU_NAME:
        return ""
    return llvm.get_host_cpu_features().flatten()


LANES: int = choose_lanes()
