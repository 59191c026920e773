"""The audit log: one line of JSON for every call that changes, or would have changed, something."""

from __future__ import annotations

import asyncio
import json
import logging
import logging.handlers
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from prometheus_client import Counter

from magic_core.errors import ConfigError

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class AuditConfig:
    """The log of mutations: who, what, with which result."""

    enabled: bool = True
    """Write it."""
    path: Path | None = None
    """The file; None takes audit.jsonl in the data folder."""
    max_bytes: int = 64 << 20
    """A file that is larger is put aside as .1, .2, ..."""
    keep: int = 8
    """So many files that were put aside are kept."""

    def __post_init__(self) -> None:
        if self.max_bytes < 4096 or self.keep < 1:
            raise ConfigError.field("audit", "max_bytes is at least 4096, keep at least 1")


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One call."""

    principal: str
    """The caller's name; empty where it was not known."""
    peer: str
    """Its address as gRPC writes it."""
    method: str
    """Full path of the method."""
    resources: tuple[str, ...]
    """What the request named."""
    request_id: str
    code: str
    """Name of the gRPC status code; OK when it was done."""
    reason: str = ""
    """ErrorInfo reason of a refusal."""
    trace_id: str = ""

    def line(self, now: datetime) -> str:
        """The entry as JSON; empty values are left out."""
        values = {
            "time": now.isoformat(timespec="milliseconds"),
            "principal": self.principal,
            "peer": self.peer,
            "method": self.method,
            "resources": list(self.resources),
            "request_id": self.request_id,
            "code": self.code,
            "reason": self.reason,
            "trace_id": self.trace_id,
        }
        return json.dumps({key: value for key, value in values.items() if value})


class AuditLog:
    """Appends entries on a thread of its own, in the order in which they come."""

    def __init__(self, config: AuditConfig, *, default: Path, failures: Counter) -> None:
        self._path = (config.path or default) if config.enabled else None
        self._config = config
        self._failures = failures
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="magic-audit")
        self._handler: logging.handlers.RotatingFileHandler | None = None
        self._closed = False

    async def write(self, entry: AuditEntry) -> None:
        """Returns once the line is in the file. A full disk is logged and counted, not raised."""
        if self._path is not None:
            line = entry.line(datetime.now(UTC))
            await asyncio.get_running_loop().run_in_executor(self._thread, self._append, line)

    async def close(self) -> None:
        """Write what is left and close the file; once more changes nothing."""
        if self._closed:
            return
        self._closed = True
        await asyncio.get_running_loop().run_in_executor(self._thread, self._close)
        self._thread.shutdown(wait=False)

    def _append(self, line: str) -> None:
        try:
            self._open().emit(logging.makeLogRecord({"msg": "%s", "args": (line,)}))
        except OSError as error:
            self._failures.inc()
            logger.error("an audit line is lost: %s", error)

    def _open(self) -> logging.handlers.RotatingFileHandler:
        if self._handler is None:
            assert self._path is not None  # only an enabled log writes
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._handler = _Handler(
                self._path, maxBytes=self._config.max_bytes, backupCount=self._config.keep
            )
        return self._handler

    def _close(self) -> None:
        if self._handler is not None:
            self._handler.close()


class _Handler(logging.handlers.RotatingFileHandler):
    """Raises what goes wrong instead of printing it."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  # logging's name
        raise  # called while the exception is being handled
