"""The file of a session archive: plain tar members in the order of a manifest that comes first."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version

from magic_core.errors import CorruptData, InvalidInput

FORMAT, VERSION = "magicslam-session", 1
MANIFEST, SESSION = "manifest.json", "session.pb"
BLOCK = 512
END = bytes(2 * BLOCK)
MAX_MANIFEST_BYTES = 64 << 20
MAX_SESSION_BYTES = 1 << 30
MAX_MEMBER_BYTES = (8 << 30) - 1
"""What the size field of a plain tar header holds."""


@dataclass(frozen=True, slots=True)
class Member:
    """One file of an archive."""

    path: str
    length: int
    sha256: str
    """In hex."""


def blob_path(sha256: str) -> str:
    """The member that holds a blob."""
    return f"blobs/{sha256}"


def manifest_of(members: Sequence[Member], *, session: str, submaps: int) -> bytes:
    """The first member: what the archive is, and every other member in order."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "software": f"magic-slam {version('magic-slam')}",
        "session": session,
        "submaps": submaps,
        "files": [{"path": m.path, "length": m.length, "sha256": m.sha256} for m in members],
    }
    return json.dumps(content, indent=1).encode()


def members_of(manifest: bytes) -> list[Member]:
    """The members that a manifest announces; raises unless they can be those of an archive."""
    try:
        content = json.loads(manifest)
        kind, number = content["format"], content["version"]
        files = content["files"] if (kind, number) == (FORMAT, VERSION) else []
        members = [Member(str(f["path"]), int(f["length"]), str(f["sha256"])) for f in files]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CorruptData(f"{MANIFEST} of the archive is not one: {error!r}") from error
    if (kind, number) != (FORMAT, VERSION):
        raise InvalidInput.field(
            MANIFEST,
            f"format {kind!r:.60} version {number!r:.20}, this build reads {FORMAT!r} version "
            f"{VERSION}; use the version of magic-slam that wrote it",
        )
    _check(members)
    return members


def _check(members: list[Member]) -> None:
    """The session first, then blobs that are named by their digests, none twice."""
    if not members or members[0].path != SESSION:
        raise CorruptData(f"the first file of the archive's manifest must be {SESSION}")
    if members[0].length > MAX_SESSION_BYTES:
        raise InvalidInput.field(SESSION, f"longer than {MAX_SESSION_BYTES} bytes")
    seen: set[str] = set()
    for member in members:
        if len(member.sha256) != 64 or not set(member.sha256) <= set("0123456789abcdef"):
            raise CorruptData(f"{member.path[:100]!r}: {member.sha256[:80]!r} is no SHA-256")
        if member.path != SESSION and member.path != blob_path(member.sha256):
            raise CorruptData(f"{member.path[:100]!r} has no place in a session archive")
        if not 1 <= member.length <= MAX_MEMBER_BYTES or member.path in seen:
            raise CorruptData(f"{member.path}: named twice, or {member.length} bytes long")
        seen.add(member.path)


def tar_header(path: str, length: int) -> bytes:
    """The block before a member's bytes."""
    info = tarfile.TarInfo(path)
    info.size = length
    return info.tobuf(tarfile.USTAR_FORMAT)


def padding(length: int) -> int:
    """Zero bytes behind a member, up to the next block."""
    return -length % BLOCK


def check_tar_header(block: bytes, path: str, length: int) -> None:
    """Raise CorruptData unless a block announces a plain file of this path and length."""
    try:
        info = tarfile.TarInfo.frombuf(block, "ascii", "strict")
    except (tarfile.HeaderError, UnicodeDecodeError) as error:
        raise CorruptData(f"not a session archive: {error} where {path} should begin") from error
    if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or info.name != path:
        raise CorruptData(f"the archive holds {info.name[:100]!r} where {path} should be")
    if info.size != length:
        raise CorruptData(
            f"{path} has {info.size} bytes in the archive, its manifest says {length}"
        )


def announced_manifest(block: bytes) -> int:
    """Length of the manifest that an archive's first block announces."""
    try:
        info = tarfile.TarInfo.frombuf(block, "ascii", "strict")
    except (tarfile.HeaderError, UnicodeDecodeError) as error:
        raise CorruptData(f"not a session archive: {error}") from error
    if info.name != MANIFEST or not 1 <= info.size <= MAX_MANIFEST_BYTES:
        raise CorruptData(f"not a session archive: it begins with {info.name[:100]!r}")
    check_tar_header(block, MANIFEST, info.size)
    return info.size
