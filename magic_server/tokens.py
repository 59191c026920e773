"""Who may call: bearer tokens and client certificates, each with a scope.

One caller a line, in a file or in an environment variable (`#` begins a comment):

    # name    scope                                  secret
    robot_1   agent:sessions/office/agents/robot_1   sha256:0f3c...   SHA-256 of the token, in hex
    robots    agent:sessions/office                  6e1d...          the token itself
    viewer    reader:sessions/office                 sha256:...
    ops       admin                                  sha256:...
    robot_2   agent:sessions/office/agents/robot_2   certificate:robot_2.example

`agent` writes as the named agent, or as any agent of the session, and reads the session. `reader`
reads one session, or all. `admin` may do everything. A certificate is named by its subject's
common name or by one of its alternative names.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magic_core.errors import ConfigError, InvalidInput
from magic_core.wire import names

Scope = Literal["agent", "reader", "admin"]

MIN_TOKEN_CHARACTERS = 16
_SHA256, _CERTIFICATE = "sha256:", "certificate:"


@dataclass(frozen=True, slots=True)
class Principal:
    """A caller that is known."""

    name: str
    scope: Scope
    session: str | None = None
    """The one session it may touch; None for all."""
    agent: str | None = None
    """The one agent it may write as; None for every agent of the session."""

    def may_read(self, session: str | None) -> bool:
        """Whether it may read a session; None stands for the list of all sessions."""
        return self.session is None or self.session == session

    def may_write(self, session: str | None, agent: str | None) -> bool:
        """Whether it may write to a session, as an agent where one is named."""
        if self.scope == "admin":
            return True
        if self.scope != "agent" or session is None or session != self.session:
            return False
        return self.agent is None or self.agent == agent


@dataclass(frozen=True, slots=True)
class _Entry:
    principal: Principal
    digest: bytes | None
    """SHA-256 of its token."""
    certificate: str | None


class TokenTable:
    """Every caller that a server knows."""

    def __init__(self, entries: Iterable[_Entry] = ()) -> None:
        self._entries = tuple(entries)

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def has_tokens(self) -> bool:
        """Whether any caller is known by a token."""
        return any(entry.digest is not None for entry in self._entries)

    @property
    def has_certificates(self) -> bool:
        """Whether any caller is known by a certificate."""
        return any(entry.certificate is not None for entry in self._entries)

    def of_token(self, token: str) -> Principal | None:
        """Whose token this is. Takes the same time for every token."""
        digest = hashlib.sha256(token.encode()).digest()
        found = None
        for entry in self._entries:
            # Every entry is compared, in constant time: how long it takes says nothing.
            if entry.digest is not None and hmac.compare_digest(entry.digest, digest):
                found = entry.principal
        return found

    def of_certificate(self, subject_names: Iterable[str]) -> Principal | None:
        """Whose certificate has one of these names."""
        wanted = set(subject_names)
        return next((e.principal for e in self._entries if e.certificate in wanted), None)


def parse_tokens(text: str, *, source: str) -> TokenTable:
    """The table of a file or variable. Raises ConfigError naming the line, never the secret."""
    entries: list[_Entry] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if words:
            entries.append(_entry(words, where=f"{source}, line {number}"))
    listed = [entry.principal.name for entry in entries]
    if twice := {name for name in listed if listed.count(name) > 1}:
        raise ConfigError(f"{source}: {', '.join(sorted(twice))} is listed more than once")
    return TokenTable(entries)


def load_tokens(path: Path) -> TokenTable:
    """The table of a file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError.field("access.tokens_file", f"{path} cannot be read: {error}") from error
    return parse_tokens(text, source=str(path))


def _entry(words: list[str], *, where: str) -> _Entry:
    if len(words) != 3:
        raise ConfigError(f"{where}: {len(words)} words, expected NAME SCOPE SECRET")
    name, scope, secret = words
    principal = _principal(name, scope, where=where)
    if secret.startswith(_CERTIFICATE):
        return _Entry(principal, None, secret.removeprefix(_CERTIFICATE))
    return _Entry(principal, _digest(secret, where=where), None)


def _principal(name: str, scope: str, *, where: str) -> Principal:
    kind, _, resource = scope.partition(":")
    try:
        match kind, bool(resource):
            case "admin", False:
                return Principal(name, "admin")
            case "reader", False:
                return Principal(name, "reader")
            case "reader", True:
                return Principal(name, "reader", names.parse_session(resource))
            case "agent", True if "/agents/" in resource:
                return Principal(name, "agent", *names.parse_agent(resource))
            case "agent", True:
                return Principal(name, "agent", names.parse_session(resource))
    except InvalidInput as error:
        raise ConfigError(f"{where}: {error.message}") from error
    raise ConfigError(
        f"{where}: scope {scope!r}, expected admin, reader, reader:sessions/S, agent:sessions/S "
        "or agent:sessions/S/agents/A"
    )


def _digest(secret: str, *, where: str) -> bytes:
    if secret.startswith(_SHA256):
        try:
            digest = bytes.fromhex(secret.removeprefix(_SHA256))
        except ValueError:
            digest = b""
        if len(digest) != hashlib.sha256().digest_size:
            raise ConfigError(f"{where}: expected 64 hexadecimal digits after sha256:")
        return digest
    if len(secret) < MIN_TOKEN_CHARACTERS:
        raise ConfigError(
            f"{where}: a token of {len(secret)} characters can be guessed; expected at least "
            f"{MIN_TOKEN_CHARACTERS}, for example from `openssl rand -hex 32`"
        )
    return hashlib.sha256(secret.encode()).digest()
