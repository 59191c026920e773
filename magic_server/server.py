"""The server: everything wired together, started, and stopped without losing anything."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import socket
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import grpc.aio
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection
from magicslam.v1 import global_map_service_pb2 as map_pb
from magicslam.v1 import global_map_service_pb2_grpc as map_grpc
from magicslam.v1 import mapping_service_pb2 as mapping_pb
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc
from magicslam.v1 import session_service_pb2 as session_pb
from magicslam.v1 import session_service_pb2_grpc as session_grpc

from magic_core import logs, tracing
from magic_core.errors import Unavailable
from magic_core.wire import server_options
from magic_server import allocator
from magic_server.access import AccessControl
from magic_server.audit import AuditLog
from magic_server.blob_watch import BlobWatch
from magic_server.calls import CallDesk
from magic_server.config import LOOPBACK, ServerConfig
from magic_server.drain import Gate
from magic_server.excerpts import Excerpts
from magic_server.globalmaps import GlobalMaps
from magic_server.health_port import HealthPort
from magic_server.interceptors import CallInterceptor
from magic_server.jobs import new_executor
from magic_server.leasing import Leasing
from magic_server.localizing import Localizer
from magic_server.metrics import Metrics
from magic_server.native_log import NativeLog
from magic_server.preview import Previews
from magic_server.probes import ProbePort
from magic_server.quotas import Quotas
from magic_server.receiving import SubmapReceiver
from magic_server.removal import Removal
from magic_server.resources import Resources
from magic_server.servicers import GlobalMapServicer, MappingServicer, SessionServicer
from magic_server.sessions import Sessions
from magic_server.signals import stop_signals
from magic_server.store import Store
from magic_server.store.bucket import bucket_of
from magic_server.tls import server_credentials
from magic_server.upkeep import Upkeep

logger = logging.getLogger(__name__)

SERVICES = tuple(
    service.full_name
    for file in (mapping_pb, map_pb, session_pb)
    for service in file.DESCRIPTOR.services_by_name.values()
)

LAST_ANSWERS_S = 1.0
"""How long the port stays open for answers once nothing is under way."""
LIVENESS, READINESS = "liveness", "readiness"
"""Names for grpc.health.v1: whether the process answers, and whether it takes calls."""
_READY_NAMES = ("", READINESS, *SERVICES)


class Server:
    """One server over one data folder.

    async with Server(config) as server:
        print(server.port)
    """

    def __init__(self, config: ServerConfig) -> None:
        self.config = config
        self.port = 0
        threads = config.limits.io_threads
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="magic-io")
        self.metrics = Metrics()
        self._jobs = new_executor(
            config.jobs,
            folder=config.data_dir,
            trace=config.tracing,
            observer=self.metrics.job_done,
            bucket=bucket_of(config.store, config.data_dir),
        )
        self._store = Store(
            config.data_dir,
            self._threads,
            partial_uploads=config.limits.partial_uploads,
            config=config.store,
            replica=config.cluster.name(config.listen.port),
            observer=self.metrics.blob_request,
        )
        shared = {"jobs": self._jobs, "threads": self._threads, "config": config}
        self.sessions = Sessions(self._store, metrics=self.metrics, **shared)
        self._maps = GlobalMaps(
            self._store,
            self.sessions,
            jobs=self._jobs,
            threads=self._store.blob_threads,
            config=config,
        )
        self._leasing: Leasing | None = None
        if self._store.leases is not None:
            self._leasing = Leasing(
                self._store.leases,
                store=self._store,
                sessions=self.sessions,
                maps=self._maps,
                config=config.cluster,
            )
        self._previews = Previews(
            self._store,
            self.sessions,
            jobs=self._jobs,
            threads=self._store.blob_threads,
            config=config.preview,
        )
        self._excerpts = Excerpts(
            self._store,
            jobs=self._jobs,
            threads=self._store.blob_threads,
            config=config.excerpts,
        )
        self.localizer = Localizer(self._store, **shared)
        self._health = health.aio.HealthServicer()  # pyright: ignore[reportAttributeAccessIssue]
        self._grpc: grpc.aio.Server | None = None
        self.gate = Gate(
            max_calls=config.limits.concurrent_calls, max_watches=config.limits.concurrent_watches
        )
        self.access = AccessControl(
            config.access,
            certificates=config.tls.client_ca is not None,
            plaintext=config.listen.insecure,
        )
        self._resources = Resources(config.data_dir, config.resources, threads=self._threads)
        self.quotas = Quotas(
            self._store,
            config.quotas,
            resources=self._resources,
            backlog=self.sessions.backlog,
            max_backlog=config.limits.session_backlog,
        )
        self._audit = AuditLog(
            config.audit,
            default=self._store.scratch / "audit.jsonl",
            failures=self.metrics.audit_failures,
        )
        self._receiver = SubmapReceiver(
            self._store, threads=self._threads, limits=config.limits, quotas=self.quotas
        )
        self._upkeep = Upkeep(
            self._store, threads=self._threads, interval_s=config.limits.upkeep_interval_s
        )
        self._watch = BlobWatch(self._store.blobs, on_change=self._tell_readiness)
        self._probes: ProbePort | None = None
        self._health_port: HealthPort | None = None

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    @property
    def address(self) -> str:
        """Where clients on this machine reach the server."""
        host = self.config.listen.host
        return f"{'127.0.0.1' if host in ('0.0.0.0', '::', '[::]') else host}:{self.port}"

    @property
    def metrics_address(self) -> str | None:
        """Where /metrics, /livez and /readyz are, None where they are off."""
        return None if self._probes is None else f"{self.config.metrics.host}:{self._probes.port}"

    @property
    def health_address(self) -> str | None:
        """Where `grpc.health.v1` answers without TLS, None where no such port is open."""
        port = self._health_port
        return None if port is None else f"{self.config.health.host}:{port.port}"

    def _public_address(self) -> str:
        """Where other machines reach the server."""
        host = self.config.listen.host
        everywhere = host in ("0.0.0.0", "::", "[::]")
        host = socket.getfqdn() if everywhere else host
        return self.config.cluster.address or f"{host}:{self.port}"

    async def start(self) -> None:
        """Open the store, take up what was left, and serve."""
        try:
            # Health answers from now on; calls are refused until everything is loaded.
            await self._listen()
            await self._store.open()
            await self._jobs.start()
            await self.sessions.start(everything=self._leasing is None)
            await self._maps.start(everything=self._leasing is None)
            if self._leasing is not None:
                await self._leasing.start(self._public_address())
            self._upkeep.start()
            await self._previews.start()
            await self._excerpts.start()
            self._watch.start()
            self.gate.open()
            await self._set_ready(True)
        except BaseException:
            await self.stop()
            raise
        logger.info(
            "serving on %s (%s), data in %s",
            self.address,
            "TLS" if self.config.tls.enabled else "plaintext",
            self.config.data_dir,
        )
        beyond = self.config.listen.host not in LOOPBACK
        if beyond and self.access.open and self.config.tls.client_ca is None:
            logger.warning("no tokens are configured: whoever can connect may do everything")

    async def stop(self) -> None:
        """Refuse new calls, let those under way finish, keep everything that was acknowledged."""
        self.gate.drain()
        if self._leasing is not None:
            await self._leasing.stop_taking()
        if self._grpc is not None:
            # The port stays open for a while, so that callers read why they are refused.
            await self._set_ready(False)
            self.sessions.dismiss_watchers()
            self._maps.dismiss_waiters()
            if not await self.gate.empty(self.config.listen.stop_grace_s):
                logger.warning("%d calls did not end in time and are cut", self.gate.calls)
            await self._grpc.stop(LAST_ANSWERS_S)
            self._grpc = None
        await self._watch.close()
        await self._upkeep.close()
        await self._receiver.close()
        await self._maps.close()
        await self._previews.close()
        await self._excerpts.close()
        await self.sessions.close()
        await self._jobs.close()
        if self._leasing is not None:
            await self._leasing.close()
        await self._store.close()
        await self._audit.close()
        if self._probes is not None:
            await asyncio.to_thread(self._probes.close)
        if self._health_port is not None:
            await self._health_port.close()
        self._threads.shutdown(wait=True)

    async def _listen(self) -> None:
        listen = self.config.listen
        desk = CallDesk(
            access=self.access,
            gate=self.gate,
            quotas=self.quotas,
            resources=self._resources,
            metrics=self.metrics,
            audit=self._audit,
            route=None if self._leasing is None else self._leasing.route,
        )
        server = grpc.aio.server(
            interceptors=[CallInterceptor(desk)], options=server_options(listen.transport)
        )
        self._add_services(server)
        await self._set_ready(False)
        await self._health.set(LIVENESS, health_pb2.HealthCheckResponse.SERVING)
        where = f"{listen.host}:{listen.port}"
        try:
            if self.config.tls.enabled:
                self.port = server.add_secure_port(where, server_credentials(self.config.tls))
            else:
                self.port = server.add_insecure_port(where)
        except RuntimeError as error:
            raise Unavailable(
                f"cannot listen on {where}; is another server running? Choose another port"
            ) from error
        await server.start()
        self._grpc = server
        if self.config.health.port is not None:
            self._health_port = HealthPort(self.config.health, self._health)
            await self._health_port.start()
        if self.config.metrics.port is not None:
            self._observe()
            self._probes = ProbePort(
                self.config.metrics, self.metrics.registry, trouble=self._trouble
            )

    def _observe(self) -> None:
        """Publish what is measured at every scrape, on the scraper's thread."""
        metrics, gate = self.metrics, self.gate
        for queue in ("search", "verify"):
            metrics.watch_queue(queue, lambda q=queue: self.sessions.depths()[q])
        metrics.watch_queue("jobs", lambda: self._jobs.waiting)
        metrics.watch_queue("calls", lambda: gate.calls)
        metrics.watch_queue("watches", lambda: gate.watches)
        metrics.watch_queue("uploads", lambda: self.quotas.held_submaps)
        room = self._resources.room
        metrics.watch("magic_disk_free_bytes", "Free on the store's disk.", lambda: room().disk)
        metrics.watch("magic_memory_free_bytes", "Memory left.", lambda: room().memory)
        metrics.watch("magic_job_slots", "Jobs at once, now.", lambda: float(self._jobs.slots))
        metrics.watch("magic_ready", "1 while calls are taken.", lambda: float(self._ready))

    @property
    def _ready(self) -> bool:
        return self.gate.ready and not self._watch.trouble

    def _trouble(self) -> str | None:
        """Why the server is not ready, None while it is."""
        return None if self._ready else self._watch.trouble

    async def _tell_readiness(self) -> None:
        await self._set_ready(self._ready)

    async def _set_ready(self, ready: bool) -> None:
        states = health_pb2.HealthCheckResponse
        for name in _READY_NAMES:
            await self._health.set(name, states.SERVING if ready else states.NOT_SERVING)

    def _add_services(self, server: grpc.aio.Server) -> None:
        mapping = MappingServicer(
            self._store,
            self.sessions,
            receiver=self._receiver,
            quotas=self.quotas,
            localizer=self.localizer,
            threads=self._threads,
            config=self.config,
        )
        mapping_grpc.add_MappingServiceServicer_to_server(mapping, server)
        maps = GlobalMapServicer(self._store, self._maps, self._previews, self._excerpts)
        map_grpc.add_GlobalMapServiceServicer_to_server(maps, server)
        sessions = SessionServicer(
            self._store,
            self.sessions,
            removal=Removal(self._store, self.sessions, self._maps, self._excerpts),
            threads=self._threads,
            limits=self.config.limits,
        )
        session_grpc.add_SessionServiceServicer_to_server(sessions, server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, server)
        others = (health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection((*SERVICES, *others), server)


async def serve(config: ServerConfig, *, on_ready: Callable[[Server], None] | None = None) -> None:
    """Serve until SIGINT or SIGTERM; `on_ready` is called once the server takes calls.

    The first signal drains the server, a second one ends the process at once. SIGHUP reads the
    callers again; certificates are read again by themselves.
    """
    allocator.keep_few_pools()
    server = Server(config)
    with _native_log(config, server), stop_signals(on_reload=server.access.reload) as stop:
        async with server, allocator.trimmed():
            _keep_the_loop_smooth()
            if on_ready is not None:
                on_ready(server)
            await stop.wait()
    await asyncio.to_thread(tracing.shut_down)


@contextlib.contextmanager
def _native_log(config: ServerConfig, server: Server) -> Iterator[None]:
    """Counts handshakes that fail, and keeps the C core's own lines out of a JSON log."""
    if not config.tls.enabled and config.logs.format == "text":
        yield
        return

    def count(reason: str) -> None:
        server.metrics.handshake_failures.labels(reason).inc()

    native = NativeLog(on_handshake_failure=count)
    logs.configure(config.logs, stream=native.stream())
    try:
        yield
    finally:
        native.close()


def _keep_the_loop_smooth() -> None:
    """Settings of a process that does nothing but serve."""
    # What is alive now stays alive: the collector need not walk through it again.
    gc.collect()
    gc.freeze()
    # The loop waits this long for threads that compute; 5 ms is Python's own figure.
    sys.setswitchinterval(0.001)
