"""Every rule that a session in an archive must keep, before any of it is stored."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping

from google.protobuf.timestamp_pb2 import Timestamp
from magicslam.v1 import archive_pb2, submap_pb2
from magicslam.v1 import session_service_pb2 as session_pb

from magic_core.errors import CorruptData, InvalidInput, MagicError
from magic_core.wire import SubmapLimits, check_blob, check_header, convert, geometry, names
from magic_core.wire.header_check import request_id_problem
from magic_server.store import ImportedSubmap, NewSubmap, Vertex, WrittenBlob, require_model
from magic_server.store.rows import SessionRow

MAX_ROW = 2**62
_VERDICTS = ("PENDING", "ACCEPTED", "REJECTED")


def check_archive(
    archive: archive_pb2.SessionArchive, blobs: Mapping[str, WrittenBlob], limits: SubmapLimits
) -> list[ImportedSubmap]:
    """The sub-maps of an archive, ready to be stored. Slow: every blob is decoded.

    Raises InvalidInput, CorruptData or ResourceExhausted, naming what is wrong.
    """
    session = _session(archive.session, limits)
    agents = _agents(archive, session.name)
    numbers = _numbers(archive, session.name, agents)
    submaps = []
    for index, entry in enumerate(archive.submaps):
        with _field(f"submaps[{index}]"):
            submaps.append(_submap(entry, session, numbers, blobs, limits))
    stored = {one.submap.vertex.name for one in submaps}
    keyframes = {one.submap.vertex.name: len(one.submap.header.keyframes) for one in submaps}
    for index, entry in enumerate(archive.removed):
        with _field(f"removed[{index}]"):
            _check_removed(entry, numbers)
    _check_loops(archive, keyframes)
    _check_snapshot(archive, stored)
    for index, entry in enumerate(archive.maps):
        with _field(f"maps[{index}]"):
            _check_map(entry, session.name, stored, blobs)
    _check_blobs_used(archive, blobs)
    return submaps


class _field:  # noqa: N801  # a context manager reads as a verb
    """Names the part of the archive in errors that are raised inside."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, MagicError):
            raise type(error)(f"{self._path}: {error.message}", violations=error.violations)
        if isinstance(error, (ValueError, OverflowError)):
            raise InvalidInput.field(self._path, str(error)) from error


def _session(message: session_pb.Session, limits: SubmapLimits) -> SessionRow:
    with _field("session"):
        name = names.parse_session(message.name)
        _check_time(message.created_at)
        if problem := request_id_problem(message.descriptor_model_id):
            raise InvalidInput.field("descriptor_model_id", problem)
        if not 1 <= message.descriptor_dimension <= limits.max_descriptor_dimension:
            longest = limits.max_descriptor_dimension
            raise InvalidInput.field("descriptor_dimension", f"expected 1 to {longest}")
        return SessionRow(0, name, message.descriptor_model_id, message.descriptor_dimension)


def _agents(archive: archive_pb2.SessionArchive, session: str) -> set[str]:
    found: set[str] = set()
    for index, agent in enumerate(archive.agents):
        with _field(f"agents[{index}]"):
            owner, name = names.parse_agent(agent.name)
            _require(owner == session and name not in found, "name", "of another session, or twice")
            _require(
                agent.state in (session_pb.AGENT_STATE_ACTIVE, session_pb.AGENT_STATE_FINISHED),
                "state",
                "must be ACTIVE or FINISHED",
            )
            _check_time(agent.registered_at)
            _check_time(agent.last_seen_at)
            found.add(name)
    return found


def _numbers(
    archive: archive_pb2.SessionArchive, session: str, agents: set[str]
) -> set[tuple[str, int]]:
    """(agent, index) of every sub-map, deleted ones included, each once."""
    found: set[tuple[str, int]] = set()
    named = [entry.header.name for entry in archive.submaps]
    for name in (*named, *(entry.name for entry in archive.removed)):
        owner, agent, index = names.parse_submap(name)
        known = owner == session and agent in agents
        _require(known and (agent, index) not in found, name, "of an unknown agent, or twice")
        found.add((agent, index))
    return found


def _submap(
    entry: archive_pb2.ArchivedSubmap,
    session: SessionRow,
    numbers: set[tuple[str, int]],
    blobs: Mapping[str, WrittenBlob],
    limits: SubmapLimits,
) -> ImportedSubmap:
    header = entry.header
    check_header(header, limits)
    _check_time(entry.received_at)
    _, agent, _ = names.parse_submap(header.name)
    require_model(session, header.image_descriptor.model_id, len(header.image_descriptor.vector))
    if header.HasField("odometry"):
        previous = (agent, header.odometry.previous_index)
        _require(previous in numbers, "odometry.previous_index", "is not in the archive")
    count = sum(_checked_blob(header, number, blobs) for number in range(len(header.blobs)))
    submap = NewSubmap(
        header=header,
        header_sha256=hashlib.sha256(header.SerializeToString(deterministic=True)).digest(),
        gaussian_count=count,
        digests=tuple(blob.sha256.hex() for blob in header.blobs),
        vertex=Vertex.of(header, searched=entry.searched),
    )
    received_at = convert.timestamp_from_proto(entry.received_at).timestamp()
    return ImportedSubmap(agent, submap, received_at, entry.searched)


def _checked_blob(
    header: submap_pb2.SubmapHeader, number: int, blobs: Mapping[str, WrittenBlob]
) -> int:
    info = header.blobs[number]
    blob = blobs.get(info.sha256.hex())
    if blob is None or blob.length != info.length:
        raise CorruptData(f"blobs[{number}] is not in the archive, or of another length")
    return check_blob(header, number, blob.content())


def _check_removed(entry: archive_pb2.ArchivedRemoval, numbers: set[tuple[str, int]]) -> None:
    _, agent, index = names.parse_submap(entry.name)
    if problem := request_id_problem(entry.request_id):
        raise InvalidInput.field("request_id", problem)
    _require(len(entry.header_sha256) == 32, "header_sha256", "must have 32 bytes")
    _require(entry.stored_bytes < MAX_ROW, "stored_bytes", "too large")
    _check_time(entry.received_at)
    if entry.HasField("odometry"):
        edge = entry.odometry
        known = edge.previous_index < index and (agent, edge.previous_index) in numbers
        _require(known, "odometry.previous_index", "is not an earlier one of the archive")
        geometry.pose_from_proto(edge.previous_from_anchor, field="odometry.previous_from_anchor")
        if problem := geometry.information_problem(edge.information):
            raise InvalidInput.field("odometry.information", problem)
    if entry.HasField("world_from_anchor_prior"):
        geometry.pose_from_proto(entry.world_from_anchor_prior, field="world_from_anchor_prior")


def _check_loops(archive: archive_pb2.SessionArchive, keyframes: Mapping[str, int]) -> None:
    """`keyframes` holds how many each stored sub-map has."""
    seen: set[tuple[str, str]] = set()
    for index, message in enumerate(archive.loops):
        with _field(f"loops[{index}]"):
            ends = message.source, message.target
            apart = message.source != message.target and ends not in seen
            known = {*ends} <= keyframes.keys() and apart
            _require(known, "source", "joins what is not in the archive, or twice")
            seen.add(ends)
            for end, name in (("source", message.source), ("target", message.target)):
                field = f"{end}_keyframe"
                there = getattr(message, field) < keyframes[name]
                _require(there, field, f"{name} has {keyframes[name]} keyframes")
            accepted = message.verdict == 2
            measured = message.HasField("target_from_source")
            _require(accepted == measured, "target_from_source", "belongs to accepted loops")
            if accepted and (problem := geometry.information_problem(message.information)):
                raise InvalidInput.field("information", problem)
            _require(accepted or not message.information, "information", "of no accepted loop")
            loop = convert.loop_from_proto(message)
            _require(loop.verdict in _VERDICTS, "verdict", "must be pending, accepted or rejected")
            _require(1 <= len(loop.reason) <= 64, "reason", "must have 1 to 64 characters")
            figures = (loop.similarity, loop.fitness, loop.rmse_m, loop.overlap)
            finite = all(map(math.isfinite, (*figures, loop.verify_seconds)))
            _require(finite, "similarity", "a figure is NaN or infinite")


def _check_snapshot(archive: archive_pb2.SessionArchive, stored: set[str]) -> None:
    if not archive.HasField("snapshot"):
        return
    with _field("snapshot"):
        message = archive.snapshot
        _require(message.session == archive.session.name, "session", "is another")
        _require(1 <= message.revision < MAX_ROW, "revision", "expected 1 or more")
        _check_time(message.solved_at)
        placed = [pose.submap for pose in message.poses]
        known = {*placed} <= stored and len({*placed}) == len(placed)
        _require(known, "poses", "of what is not in the archive, or twice")
        rows = geometry.pose_rows(pose.world_from_anchor for pose in message.poses)
        problems = [problem for problem in geometry.pose_problems(rows) if problem]
        _require(not problems, "poses", problems[0] if problems else "")
        home = {pose.component for pose in message.poses}
        _require(home <= {*placed}, "poses", "a component is not one of the sub-maps placed")
        listed = {component.id: component.submap_count for component in message.components}
        counts = {c.id: c.submap_count for c in convert.components_of(_poses(archive))}
        _require(listed == counts, "components", "are not those of the poses")


def _poses(archive: archive_pb2.SessionArchive):
    return convert.snapshot_from_proto(archive.snapshot).poses.values()


def _check_map(
    entry: archive_pb2.ArchivedMap,
    session: str,
    stored: set[str],
    blobs: Mapping[str, WrittenBlob],
) -> None:
    info = convert.map_from_proto(entry.map)
    _require(names.parse_map(info.name)[0] == session, "map.name", "of another session")
    _require({*info.submaps} <= stored and info.submaps != (), "map.submaps", "not in the archive")
    _require(info.component in info.submaps, "map.component", "is not one of its sub-maps")
    _require(max(info.revision, info.gaussian_count) < MAX_ROW, "map.revision", "too large")
    formats = [file.format for file in entry.files]
    _require(sorted(formats) == [1, 2, 3], "files", "expected one in each format")
    for file in entry.files:
        blob = blobs.get(file.sha256.hex())
        if blob is None or blob.length != file.length:
            raise CorruptData("a file of the map is not in the archive, or of another length")


def _check_blobs_used(
    archive: archive_pb2.SessionArchive, blobs: Mapping[str, WrittenBlob]
) -> None:
    used = {blob.sha256.hex() for entry in archive.submaps for blob in entry.header.blobs}
    used |= {file.sha256.hex() for entry in archive.maps for file in entry.files}
    if strays := sorted(set(blobs) - used):
        raise InvalidInput.field(f"blobs/{strays[0]}", "nothing in the archive refers to it")


def _check_time(message: Timestamp) -> None:
    """Raise ValueError or OverflowError unless it is a time that the store can hold."""
    convert.timestamp_from_proto(message).timestamp()


def _require(holds: bool, field: str, rule: str) -> None:
    if not holds:
        raise InvalidInput.field(field, rule)
