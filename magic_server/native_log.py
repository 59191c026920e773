"""What gRPC's C core writes to stderr, as log records: it knows no other way to speak.

A connection that fails its TLS handshake never becomes a call. Only the core sees it, and says so
in a line like this:

    I1122 05:44:11.767170 20883 ssl_transport_security.cc:2563] Handshake failed with error
    SSL_ERROR_SSL: error:1000007d:SSL routines:OPENSSL_internal:CERTIFICATE_VERIFY_FAILED: ...
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
from collections.abc import Callable
from typing import IO

logger = logging.getLogger("grpc.core")

_LINE = re.compile(rb"([IWEF])\d{4} \d\d:\d\d:\d\d\.\d+ +\d+ (\S+:\d+)\] (.*)")
_LEVELS = {b"I": logging.INFO, b"W": logging.WARNING, b"E": logging.ERROR, b"F": logging.CRITICAL}
_HANDSHAKE = b"Handshake failed"
_REASONS = (
    (b"certificate has expired", "CERTIFICATE_EXPIRED"),
    (b"PEER_DID_NOT_RETURN_A_CERTIFICATE", "NO_CERTIFICATE"),
    (b"WRONG_VERSION_NUMBER", "PLAINTEXT"),
    (b"HTTP_REQUEST", "PLAINTEXT"),
    (b"CERTIFICATE_VERIFY_FAILED", "CERTIFICATE_NOT_TRUSTED"),
    (b"ALERT_UNKNOWN_CA", "SERVER_NOT_TRUSTED_BY_CLIENT"),
    (b"ALERT_CERTIFICATE_EXPIRED", "SERVER_CERTIFICATE_EXPIRED"),
)


class NativeLog:
    """Takes over file descriptor 2 of this process and passes everything on.

    Lines of the core become records of the logger `grpc.core`; all else goes where it went before,
    byte for byte.
    """

    def __init__(self, *, on_handshake_failure: Callable[[str], None]) -> None:
        self._on_handshake_failure = on_handshake_failure
        self._stderr = os.dup(2)
        read, write = os.pipe()
        os.dup2(write, 2)
        os.close(write)
        self._lines = os.fdopen(read, "rb")
        self._thread = threading.Thread(target=self._relay, name="magic-stderr", daemon=True)
        self._thread.start()

    def stream(self) -> IO[str]:
        """The stderr of before, for this process's own log lines."""
        return os.fdopen(os.dup(self._stderr), "w", buffering=1, errors="replace")

    def close(self) -> None:
        """Give stderr back. Lines that were written before are passed on first."""
        os.dup2(self._stderr, 2)
        self._thread.join(timeout=1.0)  # a worker that is still alive holds the pipe open

    def _relay(self) -> None:
        for line in self._lines:
            found = _LINE.match(line)
            if found is None:
                with contextlib.suppress(OSError):  # nobody reads; whoever writes must not wait
                    os.write(self._stderr, line)
                continue
            level, place, message = found.groups()
            if message.startswith(_HANDSHAKE):
                reason = handshake_reason(message)
                self._on_handshake_failure(reason)
                logger.warning("TLS handshake refused: %s", reason)
            else:
                text = f"{place.decode(errors='replace')} {message.decode(errors='replace')}"
                logger.log(_LEVELS[level], "%s", text)


def handshake_reason(message: bytes) -> str:
    """Why a handshake failed, as a label."""
    return next((reason for mark, reason in _REASONS if mark in message), "HANDSHAKE_FAILED")
