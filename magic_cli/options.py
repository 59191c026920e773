"""Command lines from config dataclasses: `--config FILE` gives defaults, options override them."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import tyro

from magic_core.config import load_yaml
from magic_core.errors import ConfigError

T = TypeVar("T")

STYLE = (tyro.conf.FlagCreatePairsOff,)
"""A switch is `--json`, or `--no-report` where it is on by default; never both."""


def parse(cls: type[T], arguments: list[str], *, prog: str, description: str) -> T:
    """Parse a command line into a config of class `cls`.

    `--config FILE` anywhere loads a YAML file first; every other option overrides it.
    Exits with code 2 and tyro's message on a wrong option.
    """
    config_path, rest = _take_config(arguments)
    default = load_yaml(cls, config_path) if config_path else None
    if default is None:
        return tyro.cli(cls, args=rest, prog=prog, description=description, config=STYLE)
    return tyro.cli(
        cls, args=rest, prog=prog, description=description, config=STYLE, default=default
    )


def _take_config(arguments: list[str]) -> tuple[Path | None, list[str]]:
    rest: list[str] = []
    path: Path | None = None
    remaining = iter(arguments)
    for argument in remaining:
        if argument == "--config":
            value = next(remaining, None)
            if value is None:
                raise ConfigError("--config: expected a YAML file after it")
            path = Path(value)
        elif argument.startswith("--config="):
            path = Path(argument.split("=", 1)[1])
        else:
            rest.append(argument)
    return path, rest
