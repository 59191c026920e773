"""`magic check-data PATH`: what layout is this, and what is wrong with it?"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table


@dataclass(frozen=True, slots=True)
class CheckDataConfig:
    """Options of `magic check-data`."""

    path: Positional[Path]
    """Folder of a dataset: agent_*/ folders, or one recording."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Check a dataset; 1 if something is wrong with it."""
    config = parse(CheckDataConfig, arguments, prog="magic check-data", description=__doc__ or "")
    from magic_core.data import check_dataset

    report = check_dataset(config.path)
    colours = {"ok": "green", "warn": "yellow", "fail": "red"}
    rows = [
        [found.name, f"[{colours[found.status]}]{found.status}[/]", found.detail, found.remedy]
        for found in report.findings
    ]
    console.print(table(str(config.path), ["check", "status", "found", "remedy"], rows))
    if config.json:
        print_json({"ok": report.ok, "findings": [dataclasses.asdict(f) for f in report.findings]})
    return 0 if report.ok else 1
