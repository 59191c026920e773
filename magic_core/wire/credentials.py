"""How a client proves who it is and knows whom it talks to."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import grpc.aio

from magic_core import tracing
from magic_core.errors import ConfigError

LOOPBACK_HOSTS = ("127.", "localhost", "[::1]", "unix:")
Metadata = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class ClientCredentials:
    """TLS and token of a client. The default is plaintext, which only loopback servers take."""

    tls: bool = False
    """Encrypt, and trust the authorities that gRPC ships with; `ca` and `certificate` imply it."""
    ca: Path | None = None
    """PEM file of the authorities to trust instead."""
    certificate: Path | None = None
    """The client's own certificate, PEM, where the server requires one (mutual TLS)."""
    key: Path | None = None
    """Its private key, PEM."""
    server_name: str = ""
    """Name to expect in the server's certificate where it is not the one that is dialled."""
    token_file: Path | None = None
    """File that holds the client's token."""
    token_env: str = "MAGIC_TOKEN"
    """Environment variable that holds the token; used where no file is given."""
    insecure: bool = False
    """Send the token to another machine unencrypted. Whoever is on the way has it then."""

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ConfigError.field("credentials", "certificate and key belong together; give both")

    @property
    def encrypted(self) -> bool:
        """Whether connections are encrypted."""
        return self.tls or self.ca is not None or self.certificate is not None

    def token(self) -> str | None:
        """The token of file or environment, None where neither is set."""
        if self.token_file is not None:
            text = _read("credentials.token_file", self.token_file).decode(errors="replace").strip()
            if not text or not text.isprintable() or " " in text:
                raise ConfigError.field("credentials.token_file", f"{self.token_file} has no token")
            return text
        return os.environ.get(self.token_env, "").strip() or None


def open_channel(
    target: str, credentials: ClientCredentials, options: Sequence[tuple[str, int]]
) -> AnnotatedChannel:
    """A channel whose every call carries the token and the current trace.

    Raises ConfigError for a file that cannot be read, and for a token that would travel unencrypted
    to another machine.
    """
    token = credentials.token()
    if token and not credentials.encrypted and not _stays_here(target) and not credentials.insecure:
        raise ConfigError.field(
            "credentials",
            f"the token would go to {target} unencrypted; set credentials.tls or credentials.ca, "
            "or credentials.insecure to send it all the same",
        )
    if credentials.encrypted:
        channel = grpc.aio.secure_channel(target, _tls(credentials), _named(credentials, options))
    else:
        channel = grpc.aio.insecure_channel(target, options)
    return AnnotatedChannel(channel, token)


class AnnotatedChannel:
    """A channel for generated stubs that adds metadata to every call.

    gRPC's own call credentials refuse plaintext, loopback included, and its interceptors put a
    queue between a stream and its messages.
    """

    def __init__(self, channel: grpc.aio.Channel, token: str | None) -> None:
        self.channel = channel
        self._token = token

    def metadata(self) -> Metadata:
        """What a call that begins now carries."""
        pairs = []
        if self._token is not None:
            pairs.append(("authorization", f"Bearer {self._token}"))
        if (parent := tracing.traceparent()) is not None:
            pairs.append((tracing.METADATA_KEY, parent))
        return tuple(pairs)

    def unary_unary(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._annotated(self.channel.unary_unary(*arguments, **settings))

    def unary_stream(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._annotated(self.channel.unary_stream(*arguments, **settings))

    def stream_unary(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._annotated(self.channel.stream_unary(*arguments, **settings))

    def stream_stream(self, *arguments: Any, **settings: Any) -> Callable[..., Any]:
        return self._annotated(self.channel.stream_stream(*arguments, **settings))

    def _annotated(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, metadata: Sequence[tuple[str, str]] = (), **settings: Any) -> Any:
            return method(*arguments, metadata=(*self.metadata(), *metadata), **settings)

        return call


def _tls(credentials: ClientCredentials) -> grpc.ChannelCredentials:
    read = {
        name: None if path is None else _read(f"credentials.{name}", path)
        for name, path in (
            ("ca", credentials.ca),
            ("key", credentials.key),
            ("certificate", credentials.certificate),
        )
    }
    return grpc.ssl_channel_credentials(read["ca"], read["key"], read["certificate"])


def _named(
    credentials: ClientCredentials, options: Sequence[tuple[str, int]]
) -> list[tuple[str, Any]]:
    name = credentials.server_name
    return [*options, *([("grpc.ssl_target_name_override", name)] if name else [])]


def _read(field: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError.field(field, f"{path} cannot be read: {error.strerror}") from error


def _stays_here(target: str) -> bool:
    """Whether a target is this machine."""
    return target.removeprefix("dns:").lstrip("/").startswith(LOOPBACK_HOSTS)
