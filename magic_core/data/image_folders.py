"""Folders of numbered or named images, and which of two folders belong together."""

from __future__ import annotations

import re
from pathlib import Path

from magic_core.data.images import read_colour
from magic_core.errors import DataError

COLOUR_SUFFIXES = (".jpg", ".jpeg", ".png")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff")


def images_in(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Name without suffix -> file, in natural order: `9` before `10`."""
    if not folder.is_dir():
        return {}
    found = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".")
    ]
    return {path.stem: path for path in sorted(found, key=lambda path: natural_key(path.stem))}


def natural_key(name: str) -> list[tuple[int, int | str]]:
    """A sort key by which numbers count as numbers."""
    return [
        (0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", name) if part
    ]


def paired(colour: dict[str, Path], depth: dict[str, Path]) -> list[tuple[str, Path, Path]]:
    """(name, colour, depth) of the images that belong together.

    They do where their names are equal, or else where the last numbers in their names are.
    """
    same = [(name, path, depth[name]) for name, path in colour.items() if name in depth]
    if same:
        return same
    by_number = {number: path for name, path in depth.items() if (number := last_number(name))}
    return [
        (name, path, by_number[number])
        for name, path in colour.items()
        if (number := last_number(name)) in by_number and number is not None
    ]


def last_number(name: str) -> str | None:
    """The last whole number of a name without leading zeros."""
    numbers = re.findall(r"\d+", name)
    return str(int(numbers[-1])) if numbers else None


def colour_size(path: Path) -> tuple[int, int]:
    """(width, height) of a colour image; DataError where it cannot be read."""
    height, width = read_colour(path).shape[:2]
    return width, height


def require_pairs(pairs: list[tuple[str, Path, Path]], *, colour: Path, depth: Path) -> None:
    """Raise DataError where no colour image has a depth image of its name."""
    if not pairs:
        raise DataError(
            f"{colour.parent}: no image of {colour.name}/ has a depth image of the same name or "
            f"number in {depth.name}/; name both after the frame, as in {colour.name}/12.jpg and "
            f"{depth.name}/12.png"
        )
