"""Recorded sub-maps, made once: what light agents replay."""

from __future__ import annotations

import hashlib
import inspect
import struct
import tempfile
from pathlib import Path

from magicslam.v1 import submap_pb2

from magic_core.wire import EncodedSubmap, SubmapEncoding, encode_submap
from tests import small_world
from tests.small_world import LARGE, make_submap

SESSION = "faults"
_LENGTH = struct.Struct("<Q")


def recording(*, agents: int, submaps: int) -> list[list[EncodedSubmap]]:
    """[agent][index]: overlapping walks through the textured room, 256x192, 0.1 MB per sub-map."""
    return [
        [_recorded(agent, index, submaps) for index in range(submaps)] for agent in range(agents)
    ]


def _recorded(agent: int, index: int, submaps: int) -> EncodedSubmap:
    source = inspect.getsource(small_world).encode()
    name = hashlib.sha256(source + repr((agent, index, submaps, SESSION)).encode()).hexdigest()[:24]
    path = Path(tempfile.gettempdir()) / "magic-recorded" / name
    if not path.exists():
        submap = make_submap(SESSION, agent, index, camera=LARGE, submaps=submaps)
        encoded = encode_submap(submap, request_id=submap.name, encoding=SubmapEncoding())
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
