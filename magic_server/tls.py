"""TLS of the server: certificates from files, read again when they change."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from magic_core.errors import ConfigError

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TlsConfig:
    """Certificates, all PEM. Files that change are taken up by the next connection."""

    certificate: Path | None = None
    """The server's certificate, its intermediates behind it. Without it the server is plaintext."""
    key: Path | None = None
    """The certificate's private key."""
    client_ca: Path | None = None
    """Require clients to have a certificate of one of these authorities (mutual TLS)."""

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ConfigError.field("tls", "certificate and key belong together; give both")
        if self.client_ca is not None and self.certificate is None:
            raise ConfigError.field("tls.client_ca", "needs tls.certificate and tls.key as well")

    @property
    def enabled(self) -> bool:
        """Whether connections are encrypted."""
        return self.certificate is not None


def server_credentials(config: TlsConfig) -> grpc.ServerCredentials:
    """Credentials of a port. Raises ConfigError naming a file that cannot be used."""
    files = _CertificateFiles(config)
    return grpc.dynamic_ssl_server_credentials(
        files.first, files.newer, require_client_authentication=config.client_ca is not None
    )


class _CertificateFiles:
    """Looks at the files at every handshake; whoever replaces a certificate restarts nothing."""

    def __init__(self, config: TlsConfig) -> None:
        assert config.certificate is not None  # both are there: see TlsConfig
        assert config.key is not None
        self._certificate, self._key, self._client_ca = (
            config.certificate,
            config.key,
            config.client_ca,
        )
        self._lock = threading.Lock()
        self._stamp = self._stamps()
        self.first = self._load()

    def newer(self) -> Any:
        """The files' content where it has changed, None where the handshake uses what it has."""
        with self._lock:
            try:
                stamp = self._stamps()
                if stamp == self._stamp:
                    return None
                loaded = self._load()
            except ConfigError as error:
                logger.error("the old certificate stays: %s", error)
                return None
            self._stamp = stamp
            logger.info("took up the certificate in %s", self._certificate)
            return loaded

    def _load(self) -> Any:
        pair = (_read("tls.key", self._key), _read("tls.certificate", self._certificate))
        _require_pair(pair)
        roots = None if self._client_ca is None else _read("tls.client_ca", self._client_ca)
        return grpc.ssl_server_certificate_configuration([pair], roots)

    def _stamps(self) -> tuple[int, ...]:
        files = [self._certificate, self._key, self._client_ca]
        try:
            return tuple(file.stat().st_mtime_ns for file in files if file is not None)
        except OSError as error:
            raise ConfigError.field("tls", f"{error.filename}: {error.strerror}") from error


def _read(field: str, path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError.field(field, f"{path} cannot be read: {error.strerror}") from error
    if b"-----BEGIN " not in data:
        raise ConfigError.field(field, f"{path} is not PEM")
    return data


def _require_pair(pair: tuple[bytes, bytes]) -> None:
    """Raise ConfigError unless key and certificate belong together: gRPC would only log it."""
    import ssl
    import tempfile

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with tempfile.NamedTemporaryFile(suffix=".pem") as both:  # 0600; ssl reads files only
        both.write(pair[0] + b"\n" + pair[1])
        both.flush()
        try:
            context.load_cert_chain(both.name, password=lambda: b"")
        except ssl.SSLError as error:
            raise ConfigError.field("tls", f"key and certificate do not fit: {error}") from error
