"""Finds what is code in README.md and docs/: blocks, commands, options, links."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))

_BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>[^>]+?) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
_FILE = re.compile(r"^# (?P<path>[\w./-]+\.\w+)\b.*\n")


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block of a page."""

    page: str
    """Path from the repository's root."""
    line: int
    language: str
    text: str
    reason: str | None
    """Why it is not run, where a comment before it says so: <!-- not run: REASON -->."""

    @property
    def file(self) -> str | None:
        """The path in its first line, where that is a comment: the block is this file."""
        found = _FILE.match(self.text)
        return found["path"] if found else None

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    found = [
        Block(
            page=name_of(page),
            line=text.count("\n", 0, match.start("language")) + 1,
            language=match["language"],
            text=match["text"],
            reason=match["reason"],
        )
        for match in _BLOCK.finditer(text)
    ]
    fences = len(re.findall(r"^```", text, re.MULTILINE))
    assert fences == 2 * len(found), f"{name_of(page)}: a fence is not closed"
    return found


def inline_code(page: Path) -> Iterator[str]:
    """What stands between single backticks."""
    prose = _BLOCK.sub("", page.read_text())
    for found in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose):
        yield " ".join(found.split())


def shell_commands(text: str) -> Iterator[str]:
    """The lines of a shell script, continued ones joined, without empty ones and comments."""
    for line in text.replace("\\\n", " ").splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.strip()


def magic_commands(line: str) -> Iterator[list[str]]:
    """The arguments of each `magic ...` in a line of shell."""
    words = shlex.split(line, comments=True)
    command: list[str] = []
    for word in [*words, ";"]:
        if word in (";", "&&", "||", "|", "&", ">", ">>"):
            while command and re.match(r"[A-Z_]+=", command[0]):
                command.pop(0)
            if command and command[0].rpartition("/")[2] == "magic":
                yield command[1:]
            command = []
        else:
            command.append(word)
