"""One server of several that share a PostgreSQL database and a data folder."""

from __future__ import annotations

import re
import socket
import uuid
from dataclasses import dataclass

from magic_core.errors import ConfigError

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,30}")


@dataclass(frozen=True, slots=True)
class ClusterConfig:
    """This server among those that share its database; of no effect with SQLite."""

    replica: str = ""
    """Name of this server, the same after a restart: it then takes its own sessions back at once.
    Empty makes one of the machine's name and the port."""
    address: str = ""
    """HOST:PORT under which clients reach this server; other servers send its agents there. Empty
    takes listen.host, or the machine's name where that is every address."""
    lease_s: float = 5.0
    """A server that cannot be heard of for so long loses its sessions to the others, seconds."""

    def __post_init__(self) -> None:
        if self.replica and not _NAME.fullmatch(self.replica):
            raise ConfigError.field(
                "cluster.replica", f"{self.replica!r}: expected up to 31 letters, digits, . _ or -"
            )
        if self.address and not re.fullmatch(r"\S{1,240}:\d{1,5}", self.address):
            raise ConfigError.field("cluster.address", f"{self.address!r}: expected HOST:PORT")
        if not 1.0 <= self.lease_s <= 3600.0:
            raise ConfigError.field("cluster.lease_s", f"{self.lease_s}: expected 1 to 3600 s")

    def name(self, port: int) -> str:
        """The name of the server on a port; a new one where the system chooses the port."""
        if self.replica:
            return self.replica
        host = re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())[:20]
        return f"{host}-{port or uuid.uuid4().hex[:8]}"
