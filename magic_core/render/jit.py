"""The `kernel` decorator: numba's nogil compilation with a disk cache that watches every kernel.

Numba's own cache looks only at the file of the function itself, but kernels inline functions and
constants of other files. Here a compiled kernel is stored under a hash of its module, of all
modules of this package that it imports, and of the number of SIMD lanes; any change compiles
anew. Numba itself keys the entries inside by the processor and its features.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numba
from numba.core import caching

from magic_core.render.lanes import LANES

logger = logging.getLogger(__name__)

_STALE_AFTER_S = 30 * 24 * 3600.0


class _KernelLocator(caching._CacheLocator):
    """Tells numba where the compiled kernels of a module lie and when they are out of date."""

    def __init__(self, module: str) -> None:
        self._module = module

    def get_cache_path(self) -> str:
        return str(kernel_cache_folder())

    def get_source_stamp(self) -> str:
        return source_hash(self._module)

    def get_disambiguator(self) -> str:
        return f"lanes{LANES}-{source_hash(self._module)}"

    @classmethod
    def from_function(cls, py_func: Callable, py_file: str) -> _KernelLocator:
        return cls(Path(py_file).stem)


class _KernelCacheImpl(caching.CompileResultCacheImpl):
    _locator_classes: ClassVar = [_KernelLocator]


class _KernelCache(caching.FunctionCache):
    """numba's cache, saying what is compiled: it takes seconds that a user would wonder about."""

    _impl_class = _KernelCacheImpl
    _announced = False

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None:
            if not _KernelCache._announced:
                logger.info("compiling kernels for this processor, once; about half a minute")
                _KernelCache._announced = True
            self._started = time.perf_counter()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        super().save_overload(sig, data)
        name = self._py_func.__name__
        logger.info("compiled %s in %.1f s", name, time.perf_counter() - self._started)


def kernel(function: Callable) -> Any:
    """Compile `function` on its first call: IEEE arithmetic, no GIL, cached on disk.

    No fast-math: NaN must keep its meaning where Gaussians are culled, and forward and backward
    must round alike. Multiply-adds that matter are written as `fma`.
    """
    return _compiled(function, fastmath=False)


def fast_kernel(function: Callable) -> Any:
    """Like `kernel`, with fast-math: for sums of finite numbers, whose loops then use vectors."""
    return _compiled(function, fastmath=True)


def _compiled(function: Callable, *, fastmath: bool) -> Any:
    compile_ = numba.njit(nogil=True, error_model="numpy", boundscheck=False, fastmath=fastmath)
    dispatcher: Any = compile_(function)
    if kernel_cache_folder() is not None:
        dispatcher._cache = _KernelCache(function)
    return dispatcher


def inlined(function: Callable) -> Any:
    """A function that LLVM inlines into the kernels that call it; not cached on its own."""
    return numba.njit(forceinline=True, error_model="numpy", boundscheck=False)(function)


@cache
def source_hash(module: str) -> str:
    """Hash of a module of this package, of all that it imports from it, and of numba's version."""
    digest = hashlib.sha256(f"{numba.__version__} {LANES}".encode())
    for path in sorted(_imported_files(Path(__file__).with_name(f"{module}.py"))):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _imported_files(path: Path) -> set[Path]:
    """The file and every file of this package that it imports, directly or not."""
    found, open_ends = set(), [path]
    while open_ends:
        file = open_ends.pop()
        if file in found or not file.is_file():
            continue
        found.add(file)
        text = file.read_text(encoding="utf-8")
        names = re.findall(r"^from magic_core\.render\.(\w+) import", text, re.MULTILINE)
        for inner in re.findall(r"^from magic_core\.render import (.+)$", text, re.MULTILINE):
            names += [name.strip() for name in inner.split(",")]
        open_ends += [path.with_name(f"{name}.py") for name in names]
    return found


@cache
def kernel_cache_folder() -> Path | None:
    """The writable folder of compiled kernels, or None where nothing can be written.

    `MAGIC_KERNEL_CACHE` names it; the default lies in the user's cache folder.
    """
    home_cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    wanted = os.environ.get("MAGIC_KERNEL_CACHE") or f"{home_cache}/magic-slam/kernels"
    user = os.getuid() if hasattr(os, "getuid") else 0
    for folder in (Path(wanted), Path(tempfile.gettempdir()) / f"magic-slam-{user}" / "kernels"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    logger.warning("no writable folder for compiled kernels: each process compiles them anew")
    return None


def drop_stale_kernels() -> None:
    """Delete compiled kernels of other versions that are older than a month."""
    folder = kernel_cache_folder()
    for path in folder.glob("*.nb[ic]") if folder else ():
        if time.time() - path.stat().st_mtime > _STALE_AFTER_S:
            path.unlink(missing_ok=True)
