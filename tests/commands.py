"""Reads `magic ...` command lines with the real parsers, without doing what they say."""

from __future__ import annotations

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
