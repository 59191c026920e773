"""What commands print: tables and progress on stderr, one JSON object as stdout's last line."""

from __future__ import annotations

import json
import math
import sys
from typing import Any

from rich.console import Console
from rich.table import Table

console = Console(stderr=True, highlight=False)
"""Everything for people goes to stderr, so that stdout stays clean for `--json`."""


def print_json(result: dict[str, Any]) -> None:
    """Print one JSON object on one line; NaN and infinity become null."""
    sys.stdout.write(json.dumps(_finite(result), sort_keys=False) + "\n")
    sys.stdout.flush()


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if hasattr(value, "item") and getattr(value, "ndim", 0) == 0:
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def table(title: str, columns: list[str], rows: list[list[str]], *, words: bool = False) -> Table:
    """A rich table; the first column is left-aligned, the others right, or left for `words`."""
    result = Table(title=title, title_justify="left", title_style="bold")
    for number, column in enumerate(columns):
        result.add_column(column, justify="left" if number == 0 or words else "right")
    for row in rows:
        result.add_row(*row)
    return result
