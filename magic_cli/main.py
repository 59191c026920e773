"""The one command `magic`: picks a subcommand and imports nothing that it does not need."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from magic_cli import lifeline
from magic_core.errors import ConfigError, MagicError

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("magic_cli.demo", "map a generated flat with three agents, end to end"),
    "run": (
        "magic_cli.run",
        "map a dataset here: server, one process per agent, report",
    ),
    "serve": ("magic_cli.serve", "start a server that agents on any machine can join"),
    "worker": ("magic_cli.worker", "compute for servers: a worker of a Dask cluster"),
    "agent": ("magic_cli.agent", "run one agent against a server"),
    "sessions": (
        "magic_cli.sessions",
        "list, show, delete, export and import what a server stores",
    ),
    "view": ("magic_cli.view", "see a session in the browser, live or of a finished run"),
    "eval": ("magic_cli.evaluate", "measure a finished run again and rewrite its report"),
    "export": ("magic_cli.export", "write a run's map or trajectories in other formats"),
    "tracking": ("magic_cli.tracking", "how tracking went: cost, inliers, lost frames, per frame"),
    "loops": ("magic_cli.loops", "every loop candidate of a run, and why it was believed or not"),
    "render": ("magic_cli.render", "new views of a run's map, as a video or pictures"),
    "posegraph": (
        "magic_cli.posegraph",
        "`posegraph solve FILE...`: solve pose graphs in g2o files",
    ),
    "bench": ("magic_cli.bench", "run a benchmark by name"),
    "doctor": ("magic_cli.doctor", "check this machine: Python, CPU, libraries, models, disk"),
    "check-data": (
        "magic_cli.check_data",
        "name a dataset's layout and what is wrong with it",
    ),
}

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Exits 0 ok, 1 failed, 2 usage, 130 interrupted."""
    lifeline.hold()
    sys.exit(run_command(sys.argv[1:] if arguments is None else arguments))


def run_command(arguments: list[str]) -> int:
    """Run one command line and return its exit code."""
    if arguments and arguments[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(f"magic-slam {version('magic-slam')}")
        return EXIT_OK
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_usage())
        return EXIT_OK if arguments else EXIT_USAGE
    name, *rest = arguments
    if name not in COMMANDS:
        print(f"magic: no command {name!r}.\n\n{_usage()}", file=sys.stderr)
        return EXIT_USAGE
    return _guarded(importlib.import_module(COMMANDS[name][0]), rest)


def _guarded(module: Any, arguments: list[str]) -> int:
    """Call a command's `main(arguments) -> int` and turn expected errors into exit codes."""
    try:
        return module.main(arguments)
    except ConfigError as error:
        print(f"magic: {error}", file=sys.stderr)
        return EXIT_USAGE
    except MagicError as error:
        print(f"magic: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print("magic: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary}" for name, (_, summary) in COMMANDS.items()]
    head = "usage: magic COMMAND [options]     (magic COMMAND --help for one command)"
    codes = "Exit codes: 0 done, 1 failed (the reason is printed), 2 wrong options, 130 interrupted"
    return "\n".join([head, "", *lines, "", "Start with: magic demo", codes])
