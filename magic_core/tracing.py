"""Traces that follow a sub-map from the agent through the server into a job.

Off unless configured. OpenTelemetry is then needed (`pip install magic-slam[tracing]`) and is
loaded only then. A context crosses every border as a W3C `traceparent` string: gRPC metadata
between processes, a plain argument into a job.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from magic_core.errors import ConfigError

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import ReadableSpan
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Tracer

METADATA_KEY = "traceparent"
_tracer: Tracer | None = None
_provider: Any = None


@dataclass(frozen=True, slots=True)
class TracingConfig:
    """Where traces go."""

    exporter: Literal["none", "otlp", "file", "console"] = "none"
    """`otlp` sends them to a collector over HTTP, `file` appends a line of JSON per span."""
    endpoint: str = "http://127.0.0.1:4318/v1/traces"
    """The collector of `otlp`."""
    path: Path = Path("traces.jsonl")
    """The file of `file`; server, workers and agents may share one."""
    sample_ratio: float = 1.0
    """Share of traces that are recorded, 0 to 1; a trace is recorded whole or not at all."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.sample_ratio <= 1.0:
            raise ConfigError.field("tracing.sample_ratio", f"{self.sample_ratio}: expected 0 to 1")


def configure(config: TracingConfig, *, service: str, exporter: SpanExporter | None = None) -> None:
    """Trace in this process from now on; `exporter` replaces the configured one.

    Raises ConfigError when tracing is wanted and OpenTelemetry is not installed.
    """
    global _tracer, _provider
    if config.exporter == "none" and exporter is None:
        return
    try:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
        from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
    except ImportError as error:
        raise ConfigError.field(
            "tracing.exporter", f"{error}; install it: pip install 'magic-slam[tracing]'"
        ) from error
    _provider = TracerProvider(
        sampler=ParentBased(TraceIdRatioBased(config.sample_ratio)),
        resource=Resource.create({"service.name": service, "process.pid": os.getpid()}),
    )
    exporter = exporter or _exporter(config)
    _provider.add_span_processor(BatchSpanProcessor(exporter, schedule_delay_millis=500))
    _tracer = _provider.get_tracer("magic_slam")


def shut_down() -> None:
    """Send what is left and trace no more. Blocks, for seconds when the collector is gone."""
    global _tracer, _provider
    provider, _tracer, _provider = _provider, None, None
    if provider is not None:
        provider.shutdown()


@contextlib.contextmanager
def span(name: str, /, *, parent: str | None = None, **attributes: Any) -> Iterator[None]:
    """A span around a block; `parent` is a traceparent where the current context is another's.

    An exception that leaves the block is recorded in it.
    """
    if _tracer is None:
        yield
        return
    context = _context_of(parent) if parent else None
    with _tracer.start_as_current_span(name, context=context, attributes=attributes):
        yield


def annotate(**attributes: Any) -> None:
    """Add attributes to the current span."""
    if _tracer is not None:
        from opentelemetry import trace

        trace.get_current_span().set_attributes(attributes)


def traceparent() -> str | None:
    """The current context as a string for another process; None outside every span."""
    if _tracer is None:
        return None
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get(METADATA_KEY)


def trace_id() -> str | None:
    """The current trace's id, 32 hexadecimal digits; None outside every span."""
    parent = traceparent()
    return parent.split("-")[1] if parent else None


def _context_of(parent: str) -> Any:
    """The context of a traceparent; an empty one where it does not parse."""
    from opentelemetry.context import Context
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    return TraceContextTextMapPropagator().extract({METADATA_KEY: parent}, context=Context())


def _exporter(config: TracingConfig) -> SpanExporter:
    from opentelemetry.sdk.trace.export import ConsoleSpanExporter

    match config.exporter:
        case "otlp":
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

            return OTLPSpanExporter(endpoint=config.endpoint)
        case "file":
            return _file_exporter(config.path)
        case _:
            return ConsoleSpanExporter(out=sys.stderr)  # stdout belongs to the command


def _file_exporter(path: Path) -> SpanExporter:
    from opentelemetry.sdk.trace.export import SpanExporter, SpanExportResult

    class FileExporter(SpanExporter):
        """Appends whole lines, so that several processes can share the file."""

        def export(self, spans: Sequence[ReadableSpan]) -> SpanExportResult:
            lines = "".join(json.dumps(_plain(span)) + "\n" for span in spans)
            with path.open("ab", buffering=0) as file:
                file.write(lines.encode())
            return SpanExportResult.SUCCESS

    path.parent.mkdir(parents=True, exist_ok=True)
    return FileExporter()


def _plain(span: ReadableSpan) -> dict[str, Any]:
    """A span as JSON values; times in nanoseconds since 1970."""
    context = span.get_span_context()
    assert context is not None  # a finished span has one
    return {
        "name": span.name,
        "trace_id": f"{context.trace_id:032x}",
        "span_id": f"{context.span_id:016x}",
        "parent_id": f"{span.parent.span_id:016x}" if span.parent else None,
        "start_ns": span.start_time,
        "end_ns": span.end_time,
        "status": span.status.status_code.name,
        "attributes": dict(span.attributes or {}),
        "service": span.resource.attributes.get("service.name"),
        "pid": span.resource.attributes.get("process.pid"),
    }
