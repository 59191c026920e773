"""Certificates of an authority made for one test, as files."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import trustme

from magic_core.wire import ClientCredentials
from magic_server.tls import TlsConfig

LONG_AGO = datetime(2019, 1, 1, tzinfo=UTC)
AGO = datetime(2020, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Issued:
    """A certificate and its key."""

    certificate: Path
    key: Path


class Authority:
    """Issues certificates into a folder."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._authority = trustme.CA()
        self.ca = folder / "ca.pem"
        self._authority.cert_pem.write_to_path(str(self.ca))

    def issue(self, name: str, *identities: str, expired: bool = False) -> Issued:
        """A certificate with this common name, valid for these names and addresses."""
        times = {"not_before": LONG_AGO, "not_after": AGO} if expired else {}
        made = self._authority.issue_cert(*identities or (name,), common_name=name, **times)
        issued = Issued(self._folder / f"{name}.pem", self._folder / f"{name}.key")
        issued.certificate.write_bytes(b"".join(pem.bytes() for pem in made.cert_chain_pems))
        made.private_key_pem.write_to_path(str(issued.key))
        return issued

    def server(self, *, mutual: bool = False, expired: bool = False) -> TlsConfig:
        """What a server on this machine needs."""
        own = self.issue("server", "localhost", "127.0.0.1", expired=expired)
        return TlsConfig(own.certificate, own.key, self.ca if mutual else None)

    def client(self, name: str | None = None, *, expired: bool = False) -> ClientCredentials:
        """What a client needs, with a certificate of its own where it is named."""
        if name is None:
            return ClientCredentials(ca=self.ca, server_name="localhost")
        own = self.issue(name, f"{name}@example.org", expired=expired)
        return ClientCredentials(
            ca=self.ca, certificate=own.certificate, key=own.key, server_name="localhost"
        )
