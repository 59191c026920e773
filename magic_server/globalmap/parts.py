"""A merge's folder: refined blocks on disk, from which an interrupted merge goes on.

plan.json           what is merged, and how: another plan starts anew
block_0003.mgsc     a refined block, in the lossless codec
guests_0003.npz     what it made of other blocks' Gaussians, where it saw any
block_0003.json     its figures; written last, it says that the block is complete
open_0004.mgsc      the block under way, as of its last checkpoint
open_0004.json      how far that is
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.config import to_mapping
from magic_core.gaussians import GaussianCloud, codec
from magic_server.globalmap import consensus
from magic_server.globalmap.config import MergeConfig
from magic_server.globalmap.consensus import Guests
from magic_server.globalmap.placement import PlacedSource


class Parts:
    """Blocks that are done, and how far the one under way is."""

    def __init__(
        self, folder: Path, fingerprint: str, *, saved: Callable[[], None] = lambda: None
    ) -> None:
        """Take up a folder where its plan is the same, else empty it. `saved` hears of every
        checkpoint."""
        self._folder, self._fingerprint, self._saved = folder, fingerprint, saved
        folder.mkdir(parents=True, exist_ok=True)
        plan = folder / "plan.json"
        if not plan.is_file() or plan.read_text() != json.dumps(fingerprint):
            for pattern in ("block_*", "guests_*", "open_*"):
                for leftover in folder.glob(pattern):
                    leftover.unlink(missing_ok=True)
            _replace(plan, json.dumps(fingerprint).encode())

    def beside(self, name: str) -> Parts:
        """Blocks of another round of the same merge, in a folder in this one."""
        return Parts(self._folder / name, f"{self._fingerprint} {name}", saved=self._saved)

    def finished(self, block: int) -> dict[str, Any] | None:
        """The figures of a block that is done."""
        return _read_json(self._folder / f"block_{block:04d}.json")

    def path(self, block: int) -> Path:
        """The file of a block that is done."""
        return self._folder / f"block_{block:04d}.mgsc"

    def cloud(self, block: int) -> GaussianCloud:
        """A block that is done."""
        return codec.decode(self.path(block).read_bytes())

    def clouds(self, count: int) -> Iterator[GaussianCloud]:
        """All blocks, one at a time."""
        for block in range(count):
            yield self.cloud(block)

    def guests_path(self, block: int) -> Path:
        """The file of what a block that is done made of others' Gaussians."""
        return self._folder / f"guests_{block:04d}.npz"

    def guests(self, block: int, *, owners: Iterable[int]) -> list[Guests]:
        """What a block that is done made of the Gaussians of some others."""
        path = self.guests_path(block)
        return consensus.decode(path.read_bytes(), owners=owners) if path.is_file() else []

    def finish(
        self,
        block: int,
        cloud: GaussianCloud,
        figures: dict[str, Any],
        *,
        guests: Sequence[Guests] = (),
    ) -> None:
        """Keep a block that is done."""
        if guests:
            _replace(self.guests_path(block), consensus.encode(guests))
        _replace(self.path(block), codec.encode_lossless(cloud))
        _replace(self._folder / f"block_{block:04d}.json", json.dumps(figures).encode())
        for leftover in self._folder.glob(f"open_{block:04d}.*"):
            leftover.unlink(missing_ok=True)  # by an earlier try that is not dead

    def checkpoint(self, block: int, cloud: GaussianCloud, figures: dict[str, Any]) -> None:
        """Keep how far the block under way is. Adam's moments are not kept: they come back in a
        few steps."""
        _replace(self._folder / f"open_{block:04d}.mgsc", codec.encode_lossless(cloud))
        _replace(self._folder / f"open_{block:04d}.json", json.dumps(figures).encode())
        self._saved()

    def resumed(self, block: int) -> tuple[GaussianCloud, dict[str, Any]] | None:
        """The last checkpoint of a block, where there is one."""
        figures = _read_json(self._folder / f"open_{block:04d}.json")
        path = self._folder / f"open_{block:04d}.mgsc"
        if figures is None or not path.is_file():
            return None
        return codec.decode(path.read_bytes()), figures


def files_of(folder: Path) -> list[Path]:
    """All that an interrupted merge goes on from in a folder: a job's, of one block."""
    patterns = ("plan.json", "block_*", "guests_*", "open_*")
    found = sorted(path for pattern in patterns for path in folder.glob(pattern))
    return [path for path in found if path.suffix != ".partial"]


def fingerprint_of(sources: Sequence[PlacedSource], config: MergeConfig) -> str:
    """A digest of where the sub-maps are and how they are merged, on whichever machine."""
    anywhere = to_mapping(dataclasses.replace(config, threads=0))
    digest = hashlib.sha256(json.dumps(anywhere, sort_keys=True).encode())
    for source in sources:
        digest.update(rounded(source.world_from_anchor, 9))
        digest.update(rounded(np.stack(source.keyframe_poses()), 9))
    return digest.hexdigest()


def rounded(numbers: NDArray[np.float64], digits: int) -> bytes:
    """Numbers for a digest that is to be the same on processors that differ in the last bits."""
    return (np.round(numbers, digits) + 0.0).astype("<f8").tobytes()  # minus zero is zero


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except (FileNotFoundError, ValueError):
        return None


def _replace(path: Path, data: bytes) -> None:
    # Its own name: an earlier try at the same merge may not have ended yet, elsewhere.
    partial = path.with_suffix(f"{path.suffix}.{uuid.uuid4().hex}.partial")
    partial.write_bytes(data)
    partial.replace(path)
