"""Which caller may make which call: known, encrypted where it must be, and within its scope.

Every RPC has a rule. One without a rule is open to `admin` alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from magic_core.errors import InvalidInput, PermissionDenied, PlaintextRefused, Unauthenticated
from magic_core.wire import names
from magic_server.tokens import Principal, TokenTable, load_tokens, parse_tokens

Kind = Literal["read", "write", "admin"]


@dataclass(frozen=True, slots=True)
class AccessConfig:
    """Who may call. Without tokens and without `tls.client_ca` everyone who can connect may."""

    tokens_file: Path | None = None
    """File of callers, one a line: NAME SCOPE SECRET (docs/security.md). SIGHUP reads it again."""
    tokens_env: str = "MAGIC_TOKENS"
    """Environment variable that holds such lines; used where no file is given."""
    insecure_tokens: bool = False
    """Accept tokens that came unencrypted from another machine. Whoever listens has them then."""

    def load(self) -> TokenTable:
        """The callers that file or environment name; empty where neither is set."""
        if self.tokens_file is not None:
            return load_tokens(self.tokens_file)
        return parse_tokens(os.environ.get(self.tokens_env, ""), source=self.tokens_env)


@dataclass(frozen=True, slots=True)
class Rule:
    """What a call needs."""

    kind: Kind
    fields: tuple[str, ...] = ()
    """Paths of the request's fields that name what it touches."""
    heavy: bool = False
    """It needs memory and disk beyond the answer: refused while they are low."""

    @property
    def mutates(self) -> bool:
        """Whether the call changes what is stored."""
        return self.kind != "read"


RULES: dict[str, Rule] = {
    "/magicslam.v1.MappingService/RegisterAgent": Rule("write", ("agent",)),
    "/magicslam.v1.MappingService/SubmitSubmap": Rule("write", ("header.name",)),
    "/magicslam.v1.MappingService/ResumeUpload": Rule("write", ("submap",)),
    "/magicslam.v1.MappingService/FinishAgent": Rule("write", ("agent",)),
    "/magicslam.v1.MappingService/QueryLoops": Rule("read", ("submap", "session")),
    "/magicslam.v1.MappingService/ListLoops": Rule("read", ("session",)),
    "/magicslam.v1.MappingService/GetCorrectedPoses": Rule("read", ("session", "agent")),
    "/magicslam.v1.MappingService/WatchCorrectedPoses": Rule("read", ("session", "agent")),
    "/magicslam.v1.MappingService/GetTrajectory": Rule("read", ("agent",)),
    "/magicslam.v1.MappingService/Localize": Rule("read", ("session",), heavy=True),
    "/magicslam.v1.GlobalMapService/BuildGlobalMap": Rule("write", ("session",), heavy=True),
    "/magicslam.v1.GlobalMapService/GetOperation": Rule("read", ("name",)),
    "/magicslam.v1.GlobalMapService/WaitOperation": Rule("read", ("name",)),
    "/magicslam.v1.GlobalMapService/ListOperations": Rule("read", ("session",)),
    "/magicslam.v1.GlobalMapService/GetGlobalMap": Rule("read", ("name",)),
    "/magicslam.v1.SessionService/GetSession": Rule("read", ("name",)),
    "/magicslam.v1.SessionService/ListSessions": Rule("read"),
    "/magicslam.v1.SessionService/GetAgent": Rule("read", ("name",)),
    "/magicslam.v1.SessionService/ListAgents": Rule("read", ("session",)),
    "/magicslam.v1.SessionService/GetSubmap": Rule("read", ("name",)),
    "/magicslam.v1.SessionService/ListSubmaps": Rule("read", ("parent",)),
    "/magicslam.v1.SessionService/DownloadSubmap": Rule("read", ("name",)),
    "/magicslam.v1.SessionService/ExportSession": Rule("read", ("name",)),
    "/magicslam.v1.SessionService/ImportSession": Rule("admin", heavy=True),
    "/magicslam.v1.SessionService/DeleteSession": Rule("admin", ("name",)),
    "/magicslam.v1.SessionService/DeleteAgent": Rule("admin", ("name",)),
    "/magicslam.v1.SessionService/DeleteSubmap": Rule("admin", ("name",)),
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": Rule("read"),
}
ADMIN_ONLY = Rule("admin")
OPEN_TO_ALL = ("/grpc.health.v1.Health/",)
"""Health says whether the server runs, to those who must know it before they have a token."""

ANYBODY = Principal("anybody", "admin")
"""The caller of a server that knows no callers."""


class Connection(Protocol):
    """What a call says of its connection; gRPC's servicer context."""

    def peer(self) -> str: ...
    def auth_context(self) -> Mapping[str, Any]: ...
    def invocation_metadata(self) -> Any: ...


class AccessControl:
    """Knows the callers; authenticates calls and holds them to their scopes."""

    def __init__(self, config: AccessConfig, *, certificates: bool, plaintext: bool) -> None:
        """`certificates`: every connection has a verified client certificate. `plaintext`: other
        machines may connect unencrypted."""
        self._config = config
        self._certificates = certificates
        self._plaintext = plaintext
        self._table = config.load()

    @property
    def open(self) -> bool:
        """Whether everyone who can connect may do everything."""
        return not len(self._table)

    def reload(self) -> int:
        """Read the callers again; returns how many. The old ones stay when that fails.

        Blocks. Raises ConfigError, and refuses a table that has become empty: it would let
        everyone in.
        """
        table = self._config.load()
        if len(self._table) and not len(table):
            raise InvalidInput("no callers are left; stop the server to open it to everyone")
        self._table = table
        return len(table)

    def principal(self, connection: Connection) -> Principal:
        """Who calls. Raises Unauthenticated or PlaintextRefused."""
        token = _token(connection.invocation_metadata())
        identity = connection.auth_context()
        encrypted = b"ssl" in identity.get("transport_security_type", ())
        if not encrypted and not _on_this_machine(connection.peer()):
            self._require_encryption(token)
        certified = _subject_names(identity) if encrypted and self._certificates else []
        if self.open:
            # Nobody is listed: a verified certificate is trusted as its authority is.
            return Principal(certified[0], "admin") if certified else ANYBODY
        if token is not None:
            found = self._table.of_token(token)
            if found is None:
                raise Unauthenticated("the token is not known to this server; ask its operator")
            return found
        found = self._table.of_certificate(certified)
        if found is None:
            raise Unauthenticated("send a token: metadata `authorization: Bearer TOKEN`")
        return found

    def require(self, principal: Principal, method: str, request: Any) -> None:
        """Raise PermissionDenied unless the caller may touch everything that a request names.

        Raises InvalidInput for a name that is none.
        """
        if principal.scope == "admin":
            return
        rule = rule_of(method)
        named = dict(_named(request, rule.fields))
        owners = [_owner(name, field=path) for path, name in named.items()]
        for session, agent in owners or [(None, None)]:
            if not _allowed(principal, rule, session, agent):
                what = ", ".join(named.values()) or "every session"
                raise PermissionDenied(
                    f"{principal.name} ({_scope_text(principal)}) may not "
                    f"{method.rpartition('/')[2]} on {what}"
                )

    def _require_encryption(self, token: str | None) -> None:
        if not self._plaintext:
            raise PlaintextRefused("this server takes unencrypted calls from its own machine only")
        if token is not None and not self._config.insecure_tokens:
            raise PlaintextRefused(
                "a token came unencrypted and may have been read on its way: replace it, use TLS"
            )


def rule_of(method: str) -> Rule:
    """The rule of a method, by its full path."""
    return RULES.get(method, ADMIN_ONLY)


def resources_of(rule: Rule, request: Any) -> tuple[str, ...]:
    """The resource names in a request."""
    return tuple(name for _, name in _named(request, rule.fields))


def _allowed(principal: Principal, rule: Rule, session: str | None, agent: str | None) -> bool:
    if rule.kind == "read":
        return principal.may_read(session)
    return rule.kind == "write" and principal.may_write(session, agent)


def _named(request: Any, fields: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """(field, resource name) of the names in a request that are set."""
    for path in fields:
        *parents, field = path.split(".")
        message = request
        for parent in parents:
            message = getattr(message, parent) if message.HasField(parent) else None
            if message is None:
                break
        if message is not None and (name := getattr(message, field)):
            yield path, name


def _owner(name: str, *, field: str) -> tuple[str, str | None]:
    """(session, agent or None) that a resource name belongs to."""
    parts = name.split("/")
    if len(parts) >= 4 and parts[2] == "agents":
        return names.parse_agent("/".join(parts[:4]), field=field)
    return names.parse_session("/".join(parts[:2]), field=field), None


def _token(metadata: Any) -> str | None:
    """The bearer token of a call, None where it has none. Unauthenticated for another scheme."""
    for key, value in metadata or ():
        if key == "authorization":
            scheme, _, token = str(value).partition(" ")
            if scheme.lower() != "bearer" or not token.strip():
                raise Unauthenticated("expected the metadata `authorization: Bearer TOKEN`")
            return token.strip()
    return None


def _subject_names(identity: Mapping[str, Any]) -> list[str]:
    """The names in a verified client certificate."""
    fields = ("x509_common_name", "x509_subject_alternative_name")
    return [name.decode(errors="replace") for field in fields for name in identity.get(field, ())]


def _on_this_machine(peer: str) -> bool:
    """Whether a peer as gRPC writes it (`ipv4:1.2.3.4:5`, `ipv6:[::1]:5`) is this machine."""
    text = peer.replace("%5B", "[").replace("%5D", "]")
    return text.startswith(("ipv4:127.", "ipv6:[::1]:", "ipv6:[::ffff:127.", "unix:"))


def _scope_text(principal: Principal) -> str:
    resource = ""
    if principal.session is not None:
        resource = f" of {names.session_name(principal.session)}"
    if principal.session is not None and principal.agent is not None:
        resource = f" {names.agent_name(principal.session, principal.agent)}"
    return principal.scope + resource
