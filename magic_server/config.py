"""Settings of the server, one definition for YAML, the command line and tests."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from magic_core.errors import ConfigError
from magic_core.wire import SubmapLimits, Transport
from magic_server.globalmap import MergeConfig
from magic_server.jobs import JobConfig
from magic_server.localize_config import LocalizeConfig
from magic_server.loops import LoopConfig
from magic_server.posegraph import PoseGraphConfig
from magic_server.registration import RegistrationConfig

LOOPBACK = ("127.0.0.1", "localhost", "::1", "[::1]")


@dataclass(frozen=True, slots=True)
class ListenConfig:
from magic_server.resources import ResourceConfig
from magic_server.tls import TlsConfig
from magic_server.upload_config import PartialUploadLimits
    """Where the server listens."""

    host: str = "127.0.0.1"
    """Address to bind."""
    port: int = 50051
    """TCP port; 0 lets the system choose one."""
    insecure_bind: bool = False
    """Allow plain text beyond this machine. Anyone who reaches the port can then read and write."""
    stop_grace_s: float = 10.0
    """How long calls under way may take to finish when the server stops, seconds."""
    transport: Transport = field(default_factory=Transport)
    """Keepalive and message limits."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError.field("listen.port", f"{self.port}: expected 0 to 65535")
        if self.host not in LOOPBACK and not self.insecure_bind:
            raise ConfigError.field(
                "listen.host",
                f"{self.host}: without encryption the server listens on 127.0.0.1 only; "
                "set listen.insecure_bind to allow other machines",
            )


@dataclass(frozen=True, slots=True)
class ServiceLimits:
    """What the server takes at once."""

    submap: SubmapLimits = field(default_factory=SubmapLimits)
    """What one sub-map may at most be."""
    concurrent_uploads: int = 32
    """Sub-maps received at the same time; further ones wait."""
    upload_idle_s: float = 30.0
    """An upload without a message for this long is ended, seconds."""
    io_threads: int = 4
    """Threads that write, hash and check what is received."""
    drain_timeout_s: float = 120.0
    """How long a merge waits for loops that are still being verified, seconds."""


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """Everything about a server."""

    partial_uploads: PartialUploadLimits = field(default_factory=PartialUploadLimits)
    """What is kept of uploads that broke off."""
    data_dir: Path = Path("magic-data")
    """Folder of the store; it is created."""
    listen: ListenConfig = field(default_factory=ListenConfig)
    limits: ServiceLimits = field(default_factory=ServiceLimits)
    jobs: JobConfig = field(default_factory=JobConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    posegraph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
