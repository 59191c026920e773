"""What the server counts, for Prometheus: calls, refusals, queues, sub-maps, loops, jobs, disk."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
)

_RPC_BUCKETS_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)
_BLOB_BUCKETS_S = (0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)
_JOB_BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300, 1800)


class Metrics:
    """The metrics of one server, each in its own registry, so that servers never mix theirs."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        PlatformCollector(registry=registry)
        GCCollector(registry=registry)
        self._queues = Gauge(
            "magic_queue_depth", "What waits in a queue, by queue.", ("queue",), registry=registry
        )
        self._count_calls(registry)
        self._count_work(registry)
        self._count_blobs(registry)

    def _count_calls(self, registry: CollectorRegistry) -> None:
        self.rpc_seconds = Histogram(
            "magic_rpc_seconds",
            "Time of a call from its first byte to its end, by method and gRPC code.",
            ("method", "code"),
            buckets=_RPC_BUCKETS_S,
            registry=registry,
        )
        self.refusals = Counter(
            "magic_refusals",
            "Calls refused, by method and ErrorInfo reason.",
            ("method", "reason"),
            registry=registry,
        )
        self.handshake_failures = Counter(
            "magic_tls_handshake_failures",
            "Connections refused before any call, by reason.",
            ("reason",),
            registry=registry,
        )
        self.received_bytes = Counter(
            "magic_received_bytes", "Bytes of blob chunks that arrived.", registry=registry
        )
        self.audit_failures = Counter(
            "magic_audit_failures", "Audit lines that could not be written.", registry=registry
        )

    def _count_work(self, registry: CollectorRegistry) -> None:
        self.submaps = Counter("magic_submaps", "Sub-maps that became durable.", registry=registry)
        self.submap_bytes = Counter(
            "magic_submap_bytes",
            "Bytes of the blobs of sub-maps that became durable.",
            registry=registry,
        )
        self.loops = Counter(
            "magic_loops",
            "Loop candidates verified, by outcome: ACCEPTED or the reason of the refusal.",
            ("outcome",),
            registry=registry,
        )
        self.jobs = Counter(
            "magic_jobs",
            "Jobs ended, by task and outcome: ok, failed, or died with its worker.",
            ("task", "outcome"),
            registry=registry,
        )
        self.job_seconds = Histogram(
            "magic_job_seconds",
            "Time a job took in its worker; solve_pose_graph is the solver's.",
            ("task",),
            buckets=_JOB_BUCKETS_S,
            registry=registry,
        )
        self.job_wait_seconds = Histogram(
            "magic_job_wait_seconds",
            "Time a job waited for a worker.",
            ("task",),
            buckets=_JOB_BUCKETS_S,
            registry=registry,
        )

    def _count_blobs(self, registry: CollectorRegistry) -> None:
        self.blob_requests = Counter(
            "magic_blob_requests",
            "Requests to the bucket, by operation and outcome: ok, missing or failed.",
            ("operation", "outcome"),
            registry=registry,
        )
        self.blob_seconds = Histogram(
            "magic_blob_seconds",
            "Time of a request to the bucket, tries again included.",
            ("operation",),
            buckets=_BLOB_BUCKETS_S,
            registry=registry,
        )

    def job_done(self, job: str, outcome: str, waited_s: float, ran_s: float) -> None:
        """Count a job that ended."""
        self.jobs.labels(job, outcome).inc()
        if outcome == "ok":
            self.job_seconds.labels(job).observe(ran_s)
            self.job_wait_seconds.labels(job).observe(waited_s)

    def blob_request(self, operation: str, outcome: str, seconds: float) -> None:
        """Count a request to the bucket."""
        self.blob_requests.labels(operation, outcome).inc()
        self.blob_seconds.labels(operation).observe(seconds)

    def watch_queue(self, queue: str, depth: Callable[[], float]) -> None:
        """Publish a queue's depth; `depth` is called from another thread at every scrape."""
        self._queues.labels(queue).set_function(depth)

    def watch(self, name: str, description: str, value: Callable[[], float]) -> None:
        """Publish a value; `value` is called from another thread at every scrape."""
        Gauge(name, description, registry=self.registry).set_function(value)
