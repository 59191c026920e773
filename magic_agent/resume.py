"""What an agent needs to go on after it was killed: written at each hand-over, before the sub-map.

At a hand-over one frame ends a sub-map and opens the next. That frame, its odometry edge and the
Gaussians that move over are all there is of the next sub-map, so an agent that finds them again
goes on as if nothing had happened, from the frame behind. A live camera has moved on by then: the
sub-map before, read back, helps to find where it is.

`{index:06d}.state` beside the spooled sub-map of that index: the line `magicslam-resume-1`, the
length of the rest and its SHA-256, then JSON and blobs. Nothing in it is trusted unchecked: a file
that does not match its digest counts as missing.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard

from magic_agent.odometry import Opening
from magic_core.data import Frame
from magic_core.errors import CorruptData
from magic_core.evaluation import WireBytes
from magic_core.gaussians import codec
from magic_core.submap import OdometryEdge, Submap
from magic_core.wire import images

MAGIC = b"magicslam-resume-1\n"
_PREFIX = struct.Struct("<QI32s")  # length of JSON and blobs, length of JSON, SHA-256 of both


@dataclass(frozen=True, slots=True)
class ResumeState:
    """An agent right behind a finished sub-map."""

    session: str
    finished_index: int
    """Index of the sub-map that is finished."""
    next_frame: int
    """Number of the first frame that is still to be read."""
    tally: dict[str, Any]
    """The agent's counters, `Tally.to_json`."""
    wire_bytes: tuple[WireBytes, ...]
    """Sizes of the sub-maps up to and with this one."""
    opening: Opening | None
    """How the next sub-map begins; None when the sequence was over."""


@dataclass(frozen=True, slots=True)
class ResumePoint:
    """Where tracking goes on."""

    next_index: int
    """Index of the next sub-map."""
    opening: Opening | None = None
    """Its first frame; None when that is lost and the next frame has to be found in `memory`."""
    memory: Submap | None = None
    """The last finished sub-map."""


def encode(state: ResumeState) -> bytes:
    """The bytes of a state's file. Slow: images are compressed."""
    header: dict[str, Any] = {
        "session": state.session,
        "finished_index": state.finished_index,
        "next_frame": state.next_frame,
        "tally": state.tally,
        "wire_bytes": [[size.compact, size.lossless] for size in state.wire_bytes],
    }
    blobs: list[bytes] = []
    if state.opening is not None:
        frame, edge, carried = (
            state.opening.frame,
            state.opening.odometry,
            state.opening.carried,
        )
        header["opening"] = {
            "frame_index": frame.index,
            "timestamp_s": frame.timestamp_s,
            "shape": frame.depth.shape,
            "odometry": None if edge is None else _edge_to_json(edge),
        }
        depth = np.ascontiguousarray(frame.depth, "<f4").tobytes()
        blobs = [images.encode_colour_png(frame.colour), zstandard.compress(depth, 3)]
        if carried is not None:
            blobs.append(codec.encode_lossless(carried))
    header["blobs"] = [len(blob) for blob in blobs]
    text = json.dumps(header).encode()
    rest = b"".join((text, *blobs))
    return MAGIC + _PREFIX.pack(len(rest), len(text), hashlib.sha256(rest).digest()) + rest


def decode(data: bytes) -> ResumeState:
    """The state of a file's bytes; CorruptData when they are not what was written."""
    begin = len(MAGIC) + _PREFIX.size
    if not data.startswith(MAGIC) or len(data) < begin:
        raise CorruptData("not the state of an agent")
    length, text_length, digest = _PREFIX.unpack_from(data, len(MAGIC))
    rest = data[begin:]
    if len(rest) != length or hashlib.sha256(rest).digest() != digest:
        raise CorruptData("its SHA-256 does not match")
    header = json.loads(rest[:text_length])
    return ResumeState(
        session=header["session"],
        finished_index=header["finished_index"],
        next_frame=header["next_frame"],
        tally=header["tally"],
        wire_bytes=tuple(WireBytes(*sizes) for sizes in header["wire_bytes"]),
        opening=_opening(header, rest[text_length:]),
    )


def _opening(header: dict[str, Any], data: bytes) -> Opening | None:
    if "opening" not in header:
        return None
    blobs, begin = [], 0
    for length in header["blobs"]:
        blobs.append(data[begin : begin + length])
        begin += length
    values = header["opening"]
    height, width = values["shape"]
    depth = np.frombuffer(zstandard.decompress(blobs[1]), "<f4").astype(np.float32)
    frame = Frame(
        index=values["frame_index"],
        timestamp_s=values["timestamp_s"],
        colour=images.decode_colour(blobs[0], images.PNG, size=(width, height)),
        depth=depth.reshape(height, width),
    )
    return Opening(
        frame,
        None if values["odometry"] is None else _edge_from_json(values["odometry"]),
        codec.decode(blobs[2]) if len(blobs) > 2 else None,
    )


def _edge_to_json(edge: OdometryEdge) -> dict[str, Any]:
    return {
        "previous_index": edge.previous_index,
        "previous_from_anchor": edge.previous_from_anchor.tolist(),
        "information": edge.information.tolist(),
    }


def _edge_from_json(values: dict[str, Any]) -> OdometryEdge:
    return OdometryEdge(
        values["previous_index"],
        np.array(values["previous_from_anchor"], np.float64),
        np.array(values["information"], np.float64),
    )
