"""How blocks of the pages are shown: what is run, what stands for what, what is only read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from google.protobuf import json_format
from magicslam.v1 import submap_pb2

from magic_core.data.intrinsics import read_intrinsics
from magic_server.tokens import parse_tokens

RUN = ("bash", "python", "diff")
"""Languages that are run: commands, scripts, and changes of the source, which are applied."""

ELSEWHERE = {
    ("docs/adding-a-data-source.md", "python"): "tests/core/test_data_docs.py",
}
"""Blocks that another test runs, which needs its own frames for it."""


@dataclass(frozen=True, slots=True)
class Replacement:
    """What runs in the place of what stands in a page."""

    written: str
    """A regular expression."""
    run: str
    """{port} is the port of the page's server, {folder} the prepared folder."""
    because: str


REPLACED = (
    Replacement(
        r"\bmake demo\b.*",
        "make -n demo | grep -q 'magic demo' && magic demo --frames 24 --flat.width 160"
        " --flat.height 120 --flat.detail draft --data runs/demo-data --out runs/demo"
        " --merge.passes 2",
        "the same flat, smaller",
    ),
    Replacement(r"\bmake test\b", "make -n test", "it would run itself"),
    Replacement(r"\bmake setup\b", "make -n setup", "everything is installed already"),
    Replacement(r"\.venv/bin/magic\b", "magic", "the environment of this test"),
    Replacement(r"\bruns/demo-[\d-]+", "runs/demo", "a page names a folder of its author"),
    Replacement(r"\bDATASET\b", "~/recordings/office", "a page's word for any dataset"),
    Replacement(r" /srv/magic\b", " srv/magic", "no folder of the machine's own"),
    Replacement(r"\bmap\.example:50051\b", "localhost:{port}", "a host that does not exist"),
    Replacement(r"\b(localhost|127\.0\.0\.1):50051\b", r"127.0.0.1:{port}", "a free port"),
    Replacement(
        r"\bmagic run (?!--help)", "magic run --merge.passes 2 ", "the same, with a coarser map"
    ),
    Replacement(
        r"\bmagic agent (?!--help)", "magic agent --server 127.0.0.1:{port} ", "a free port"
    ),
    Replacement(
        r"\bmagic serve\b(?!.*--help)",
        "magic serve --port {port} --progress json",
        "a free port, and a line that says when it is ready",
    ),
    Replacement(
        r"\bmagic view\b", "magic view --progress json", "a line that says when it is ready"
    ),
)


def replaced(text: str, *, port: int) -> str:
    """The text of a block as it is run here."""
    for replacement in REPLACED:
        text = re.sub(replacement.written, replacement.run, text)
    return text.replace("{port}", str(port))


STAYS = re.compile(r"^magic (serve|view)\b")
"""Commands that run until they are stopped: they are awaited, and stopped behind the page."""

BEFORE = {
    "docs/clients.md": ("magic serve --data-dir data",),
}
"""What a page takes for granted."""


def _header(text: str, _: Path) -> None:
    header = submap_pb2.SubmapHeader()
    json_format.Parse(text, header)
    assert len(header.blobs) == 3


def _intrinsics(text: str, folder: Path) -> None:
    path = folder / "cam_params.json"
    path.write_text(text)
    assert read_intrinsics(path).camera.width == json.loads(text)["camera"]["w"]


def _callers(text: str, _: Path) -> None:
    """Digests that are cut short on the page are made whole."""
    whole = re.sub(r"sha256:\S*\.\.\.", "sha256:" + 64 * "0", text)
    whole = re.sub(r"(?<=\s)[0-9a-f]{8}\.\.\.", 16 * "0f", whole)
    parse_tokens(whole, source="the page")


PARSED: dict[tuple[str, str], Callable[[str, Path], None]] = {
    ("docs/clients.md", "json"): _header,
    ("docs/own-data.md", "json"): _intrinsics,
    ("docs/security.md", "text"): _callers,
}
"""Blocks that are data: read as what the page says they are."""
