"""`magic check-data PATH`: what layout is this, and what is wrong with it?

Names the layout, checks files, intrinsics, depth unit, timestamps and the convention of the poses,
and draws a picture: colour, depth, the edges of depth over colour, and frames joined by their
poses. Ends with 1 if something is wrong.

Examples:
  magic check-data ~/recordings/office
  magic check-data kitchen.r3d --picture kitchen.png
  magic check-data "rosbag:walk.bag?colour=/head/color&depth=/head/depth" --all
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from magic_cli.options import parse
from magic_cli.output import console, print_json, table
from magic_core.errors import DataError


@dataclass(frozen=True, slots=True)
class CheckDataConfig:
    """Options of `magic check-data`."""

    path: Positional[str]
    """One recording (folder, .r3d, .bag, .mcap or .db3), or a folder with one per agent."""
    picture: Path | None = None
    """PNG to write; default NAME-check.png here."""
    draw: bool = True
    """Draw the picture."""
    all: bool = False
    """Read every frame, not a sample of them."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(arguments: list[str]) -> int:
    """Check a dataset; 1 if something is wrong with it."""
    config = parse(CheckDataConfig, arguments, prog="magic check-data", description=__doc__ or "")
    from magic_core.data import check_dataset

    with console.status("reading"):
        report = check_dataset(config.path, read_all=config.all)
    colours = {"ok": "green", "warn": "yellow", "fail": "red"}
    rows = [
        [found.name, f"[{colours[found.status]}]{found.status}[/]", found.detail, found.remedy]
        for found in report.findings
    ]
    console.print(table(config.path, ["check", "status", "found", "remedy"], rows, words=True))
    opened = report.findings[0].status != "fail"
    picture = _picture(config, report) if config.draw and opened else None
    if config.json:
        findings = [dataclasses.asdict(found) for found in report.findings]
        shown = str(picture) if picture else None
        print_json({"ok": report.ok, "findings": findings, "picture": shown})
    return 0 if report.ok else 1


def _picture(config: CheckDataConfig, report) -> Path | None:
    """Draw the contact sheet; a dataset that cannot be opened has none."""
    from magic_core.data.picture import draw_picture

    name = Path(config.path.split("?", 1)[0]).name or "data"
    try:
        with console.status("drawing"):
            path = draw_picture(report, config.picture or Path(f"{name}-check.png"))
    except DataError as error:
        console.print(f"No picture: {error}", markup=False, soft_wrap=True)
        return None
    console.print(f"Picture: {path}", markup=False, soft_wrap=True)
    return path
