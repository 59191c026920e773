"""Command lines from config dataclasses: `--config FILE` gives defaults, options override them."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import TypeVar

import tyro

from magic_core.config import load_yaml
from magic_core.errors import ConfigError

T = TypeVar("T")

_MAIN_PARTS = ("positional arguments", "options")
_PART = re.compile(r"^ (positional arguments|(?:\S+ )?options) *\n -{20,} *\n", re.MULTILINE)

STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
"""A switch is `--json`, or `--no-report` where it is on by default; never both. Positional
arguments are called by their names, `DATASET` and not `STR`."""


def parse(cls: type[T], arguments: list[str], *, prog: str, description: str) -> T:
    """Parse a command line into a config of class `cls`.

    `--config FILE` anywhere loads a YAML file first; every other option overrides it.
    `--help` shows what most people want, `--help-all` every setting. Exits with code 2 and tyro's
    message on a wrong option.
    """
    if "--help-all" in arguments:
        arguments = ["--help"]
    elif "-h" in arguments or "--help" in arguments:
        print(short_help(_help(cls, prog, description), prog=prog), end="")
        raise SystemExit(0)
    config_path, rest = _take_config(arguments)
    default = load_yaml(cls, config_path) if config_path else None
    if default is None:
        return tyro.cli(cls, args=rest, prog=prog, description=description, config=STYLE)
    return tyro.cli(
        cls, args=rest, prog=prog, description=description, config=STYLE, default=default
    )


def short_help(full: str, *, prog: str) -> str:
    """The help of a command without the settings of its parts; these are counted and named."""
    before, *parts = _PART.split(full)
    kept, groups = [before], {}
    for title, body in zip(parts[::2], parts[1::2], strict=True):
        if title in _MAIN_PARTS:
            kept.append(f"{title}:\n{body.rstrip()}\n\n")
            continue
        name = title.removesuffix(" options").split(".", 1)[0]
        words, count = groups.get(name, (body.strip().splitlines()[0].strip(), 0))
        groups[name] = (words, count + len(re.findall(r"^  --[a-z]", body, flags=re.MULTILINE)))
    if groups:
        width = max(map(len, groups)) + 4
        kept.append(
            f"more settings (all in {prog} --help-all; --config FILE reads them as YAML):\n"
        )
        kept += [f"  {f'--{name}.*':<{width}} {words} ({count})\n"
                 for name, (words, count) in groups.items()]  # fmt: skip
    return "".join(kept)


def _help(cls: type, prog: str, description: str) -> str:
    """Everything that tyro says of a config class, in its plain style."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.cli(cls, args=["--help"], prog=prog, description=description, config=STYLE)
    return text.getvalue()


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
