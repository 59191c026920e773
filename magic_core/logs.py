"""Log lines that say whom they are about: text for people, or one JSON object a line.

with bound(session="office", agent="robot_1"):
    logger.info("3 loop candidates")
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import IO, Literal

from magic_core import tracing
from magic_core.errors import ConfigError

_IDS: ContextVar[Mapping[str, str]] = ContextVar("magic_log_ids", default={})  # noqa: B039


@dataclass(frozen=True, slots=True)
class LogConfig:
    """How log lines look."""

    format: Literal["text", "json"] = "text"
    """`json` writes one object a line: time, level, logger, message, session, agent, submap,
    trace_id."""
    level: str = "INFO"
    """DEBUG, INFO, WARNING or ERROR."""

    def __post_init__(self) -> None:
        if self.level not in ("DEBUG", "INFO", "WARNING", "ERROR"):
            expected = "expected DEBUG, INFO, WARNING or ERROR"
            raise ConfigError.field("logs.level", f"{self.level!r}: {expected}")


@contextlib.contextmanager
def bound(**ids: str) -> Iterator[None]:
    """Every line logged within, and in tasks begun within, carries these ids."""
    token = _IDS.set({**_IDS.get(), **ids})
    try:
        yield
    finally:
        _IDS.reset(token)


def bind(**ids: str) -> None:
    """The same for the rest of the current task."""
    _IDS.set({**_IDS.get(), **ids})


def configure(config: LogConfig = LogConfig(), *, stream: IO[str] | None = None) -> None:
    """Send all log lines of this process to stderr, or a stream, in the configured form."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.addFilter(_add_ids)
    handler.setFormatter(JsonFormatter() if config.format == "json" else TextFormatter())
    logging.basicConfig(level=config.level, handlers=[handler], force=True)


class TextFormatter(logging.Formatter):
    """`time logger LEVEL message [session=office agent=robot_1]`."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(name)s %(levelname)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # logging's name
        line = super().formatMessage(record)
        ids = " ".join(f"{key}={value}" for key, value in record.__dict__.get("ids", {}).items())
        return f"{line} [{ids}]" if ids else line


class JsonFormatter(logging.Formatter):
    """One JSON object a line, a traceback included."""

    def format(self, record: logging.LogRecord) -> str:
        values: dict[str, str] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
            **record.__dict__.get("ids", {}),
        }
        if trace_id := tracing.trace_id():
            values["trace_id"] = trace_id
        if record.exc_info:
            values["error"] = self.formatException(record.exc_info)
        return json.dumps(values)


def _add_ids(record: logging.LogRecord) -> bool:
    record.ids = dict(_IDS.get())
    return True
