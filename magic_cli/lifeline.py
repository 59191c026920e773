"""A child process that ends with the one that started it, even when that one is killed.

The parent holds the writing end of the child's stdin and never writes. However the parent ends,
the system closes that end, and the child asks itself to stop.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading

VARIABLE = "MAGIC_LIFELINE"


def tied(environment: dict[str, str]) -> dict[str, str]:
    """The environment of a child whose stdin is a pipe that we hold."""
    return {**environment, VARIABLE: "stdin"}


def hold() -> None:
    """Stop this process by SIGTERM when its stdin closes, if its parent asked for that."""
    # Taken out, so that our own children are not tied to a stdin that is not theirs.
    if os.environ.pop(VARIABLE, None) == "stdin":
        threading.Thread(target=_watch, name="lifeline", daemon=True).start()


def _watch() -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    os.kill(os.getpid(), signal.SIGTERM)
