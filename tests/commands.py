"""Reads `magic ...` command lines with the real parsers, without doing what they say."""

from __future__ import annotations

import contextlib
import io
import re
from typing import Any
from unittest import mock

import tyro

from magic_cli.main import run_command


class _Parsed(Exception):
    """The command line is right: this is what it says."""

    def __init__(self, config: object) -> None:
        self.config = config


def parse_command(arguments: list[str]) -> object:
    """The config that `magic ARGUMENTS` would run with; None where it only prints help.

    Raises AssertionError with what the command would have printed.
    """
    real = tyro.cli

    def stop_behind_the_parser(*args: Any, **options: Any) -> None:
        raise _Parsed(real(*args, **options))

    with mock.patch.object(tyro, "cli", stop_behind_the_parser):
        try:
            code = run_command(arguments)
        except _Parsed as parsed:
            return parsed.config
        except SystemExit as end:
            code = end.code
    assert code == 0, f"magic {' '.join(arguments)}: exit code {code}"
    return None


def options_of(*command: str) -> set[str]:
    """Every option that a command has, the settings of its parts included."""
    found: set[str] = set()
    real = tyro.cli

    def read(cls: type, *_: Any, **options: Any) -> None:
        for name in ("prog", "description", "args"):
            options.pop(name, None)
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            real(cls, args=["--help"], **options)
        found.update(re.findall(r"(?<!\S)--[a-z][\w.-]*", text.getvalue()))
        raise _Parsed(cls)

    with mock.patch.object(tyro, "cli", read), contextlib.suppress(_Parsed):
        run_command([*command, "--help-all"])
    return found
