"""An HTTP port for those who watch the server: /metrics, /livez and /readyz.

It runs on threads of its own, so that a slow scraper holds up nothing.
"""

from __future__ import annotations

import socketserver
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app

from magic_core.errors import ConfigError, Unavailable

MAX_READERS = 32
"""Connections answered at a time; further ones are closed."""
_TEXT = (("Content-Type", "text/plain; charset=utf-8"),)


@dataclass(frozen=True, slots=True)
class MetricsConfig:
    """The HTTP port of /metrics, /livez and /readyz. It holds no secrets, but names of sessions."""

    port: int | None = None
    """TCP port; 0 lets the system choose one, None opens none."""
    host: str = "127.0.0.1"
    """Address to bind."""

    def __post_init__(self) -> None:
        if self.port is not None and not 0 <= self.port <= 65535:
            raise ConfigError.field("metrics.port", f"{self.port}: expected 0 to 65535")


class ProbePort:
    """Serves metrics and health over HTTP."""

    def __init__(
        self,
        config: MetricsConfig,
        registry: CollectorRegistry,
        *,
        trouble: Callable[[], str | None],
    ) -> None:
        """`trouble` says why the server is not ready, None while it is; from another thread."""
        self._metrics = make_wsgi_app(registry)
        self._trouble = trouble
        assert config.port is not None  # whoever wants no port makes none
        try:
            self._http = make_server(
                config.host, config.port, self._answer, _ThreadingServer, _QuietHandler
            )
        except OSError as error:
            raise Unavailable(
                f"cannot listen on {config.host}:{config.port} for metrics: {error.strerror}; "
                "choose another metrics.port"
            ) from error
        self.port: int = self._http.server_port
        self._thread = threading.Thread(
            target=self._http.serve_forever, kwargs={"poll_interval": 0.1}, name="magic-probes",
            daemon=True,
        )  # fmt: skip
        self._thread.start()

    def close(self) -> None:
        """Close the port. Blocks for up to a tenth of a second."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()

    def _answer(self, environment: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        match environment.get("PATH_INFO"):
            case "/metrics":
                return self._metrics(environment, start)
            case "/livez":
                start("200 OK", list(_TEXT))
                return [b"alive\n"]
            case "/readyz":
                trouble = self._trouble()
                start("200 OK" if trouble is None else "503 Service Unavailable", list(_TEXT))
                if trouble is None:
                    return [b"ready\n"]
                return [f"not ready: {trouble}\n".encode() if trouble else b"not ready\n"]
        start("404 Not Found", list(_TEXT))
        return [b"/metrics, /livez, /readyz\n"]


class _ThreadingServer(socketserver.ThreadingMixIn, WSGIServer):
    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._places = threading.BoundedSemaphore(MAX_READERS)
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader that went away is no news."""


class _QuietHandler(WSGIRequestHandler):
    timeout = 10.0

    def log_message(self, format: str, *args: Any) -> None:
        """Scrapes are no news."""
