"""Settings of the server, one definition for YAML, the command line and tests."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from magic_core.errors import ConfigError
from magic_core.logs import LogConfig
from magic_core.tracing import TracingConfig
from magic_core.wire import SubmapLimits, Transport
from magic_server.access import AccessConfig
from magic_server.audit import AuditConfig
from magic_server.cluster_config import ClusterConfig
from magic_server.excerpt_config import ExcerptConfig
from magic_server.globalmap import MergeConfig
from magic_server.health_port import HealthPortConfig
from magic_server.jobs import JobConfig
from magic_server.localize_config import LocalizeConfig
from magic_server.loops import LoopConfig
from magic_server.posegraph import PoseGraphConfig
from magic_server.preview_config import PreviewConfig
from magic_server.probes import MetricsConfig
from magic_server.quotas import QuotaConfig
from magic_server.registration import RegistrationConfig
from magic_server.resources import ResourceConfig
from magic_server.store_config import StoreConfig
from magic_server.tls import TlsConfig
from magic_server.upload_config import PartialUploadLimits

LOOPBACK = ("127.0.0.1", "localhost", "::1", "[::1]")


@dataclass(frozen=True, slots=True)
class ListenConfig:
    """Where the server listens."""

    host: str = "127.0.0.1"
    """Address to bind."""
    port: int = 50051
    """TCP port; 0 lets the system choose one."""
    insecure: bool = False
    """Allow plaintext beyond this machine. Whoever is on the way can then read and change
    everything; prefer tls.certificate and tls.key."""
    stop_grace_s: float = 10.0
    """How long calls under way may take to finish when the server stops, seconds. A second
    SIGTERM ends it at once."""
    transport: Transport = field(default_factory=Transport)
    """Keepalive and message limits."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError.field("listen.port", f"{self.port}: expected 0 to 65535")


@dataclass(frozen=True, slots=True)
class ServiceLimits:
    """What the server takes at once."""

    submap: SubmapLimits = field(default_factory=SubmapLimits)
    """What one sub-map may at most be."""
    concurrent_uploads: int = 32
    """Sub-maps received at the same time; further ones wait."""
    concurrent_calls: int = 1000
    """Calls under way at the same time, watches apart; further ones are refused."""
    concurrent_watches: int = 1000
    """WatchCorrectedPoses streams open at the same time; further ones are refused."""
    open_operations: int = 8
    """Merges of one session that wait or run; further ones are refused."""
    session_backlog: int = 20_000
    """Searches and verifications that wait in one session before it takes no more sub-maps."""
    upload_idle_s: float = 30.0
    """An upload without a message for this long is ended, seconds."""
    partial_uploads: PartialUploadLimits = field(default_factory=PartialUploadLimits)
    """What is kept of uploads that broke off."""
    upkeep_interval_s: float = 600.0
    """How often files are looked for that nobody will ask for again, seconds."""
    io_threads: int = 4
    """Threads that write, hash and check what is received."""
    drain_timeout_s: float = 120.0
    """How long a merge waits for loops that are still being verified, seconds."""


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """Everything about a server."""

    data_dir: Path = Path("magic-data")
    """Folder of the store; it is created."""
    store: StoreConfig = field(default_factory=StoreConfig)
    cluster: ClusterConfig = field(default_factory=ClusterConfig)
    listen: ListenConfig = field(default_factory=ListenConfig)
    tls: TlsConfig = field(default_factory=TlsConfig)
    access: AccessConfig = field(default_factory=AccessConfig)
    limits: ServiceLimits = field(default_factory=ServiceLimits)
    quotas: QuotaConfig = field(default_factory=QuotaConfig)
    resources: ResourceConfig = field(default_factory=ResourceConfig)
    metrics: MetricsConfig = field(default_factory=MetricsConfig)
    health: HealthPortConfig = field(default_factory=HealthPortConfig)
    audit: AuditConfig = field(default_factory=AuditConfig)
    logs: LogConfig = field(default_factory=LogConfig)
    tracing: TracingConfig = field(default_factory=TracingConfig)
    jobs: JobConfig = field(default_factory=JobConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    posegraph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    preview: PreviewConfig = field(default_factory=PreviewConfig)
    excerpts: ExcerptConfig = field(default_factory=ExcerptConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)

    def __post_init__(self) -> None:
        host = self.listen.host
        if host not in LOOPBACK and not self.tls.enabled and not self.listen.insecure:
            raise ConfigError.field(
                "listen.host",
                f"{host}: without encryption the server listens on 127.0.0.1 only; give "
                "tls.certificate and tls.key, or listen.insecure for plaintext",
            )
