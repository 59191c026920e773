"""Recorded sub-maps, made once: what light agents replay."""

from __future__ import annotations

import hashlib
import inspect
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

from magicslam.v1 import submap_pb2

from magic_core.wire import EncodedSubmap, encode_submap
from tests import load, small_world
from tests.small_world import LARGE, make_submap

SESSION = "faults"
_LENGTH = struct.Struct("<Q")


def recording(*, agents: int, submaps: int) -> list[list[EncodedSubmap]]:
    """[agent][index]: overlapping walks through the textured room, 256x192, 0.1 MB per sub-map."""

    def make(agent: int, index: int) -> EncodedSubmap:
        submap = make_submap(SESSION, agent, index, camera=LARGE, submaps=submaps)
        return encode_submap(submap, request_id=submap.name)

    return _kept(make, agents=agents, submaps=submaps)


def large_recording(*, agents: int, submaps: int) -> list[list[EncodedSubmap]]:
    """[agent][index]: 640x480 with a sensor's noise, lossless, 5 MB per sub-map, session `load`."""
    return _kept(
        lambda agent, index: load.encoded(agent, index, submaps=submaps),
        agents=agents,
        submaps=submaps,
    )


def _kept(
    make: Callable[[int, int], EncodedSubmap], *, agents: int, submaps: int
) -> list[list[EncodedSubmap]]:
    """What `make` makes of (agent, index), made once for this version of the makers."""
    source = inspect.getsource(small_world) + inspect.getsource(load) + make.__qualname__
    return [
        [
            _recorded(f"{source}{agent}/{i}/{submaps}", lambda a=agent, i=i: make(a, i))
            for i in range(submaps)
        ]
        for agent in range(agents)
    ]


def _recorded(key: str, make: Callable[[], EncodedSubmap]) -> EncodedSubmap:
    name = hashlib.sha256(key.encode()).hexdigest()[:24]
    path = Path(tempfile.gettempdir()) / "magic-recorded" / name
    if not path.exists():
        encoded = make()
        header = encoded.header.SerializeToString()
        path.parent.mkdir(exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_bytes(_LENGTH.pack(len(header)) + header + b"".join(encoded.blobs))
        partial.replace(path)
    return _read(path.read_bytes())


def _read(data: bytes) -> EncodedSubmap:
    (length,) = _LENGTH.unpack_from(data)
    begin = _LENGTH.size + length
    header = submap_pb2.SubmapHeader.FromString(data[_LENGTH.size : begin])
    blobs = []
    for blob in header.blobs:
        blobs.append(data[begin : begin + blob.length])
        begin += blob.length
    return EncodedSubmap(header, tuple(blobs))
