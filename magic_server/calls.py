"""What happens around every call: who calls, may they, is there room, what came of it."""

from __future__ import annotations

import contextlib
import logging
import time
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import grpc.aio
from magicslam.v1 import mapping_service_pb2 as mapping_pb

from magic_core import logs, tracing
from magic_core.errors import MagicError, MemoryLow
from magic_core.wire import grpc_status_of
from magic_server.access import ANYBODY, AccessControl, Rule, resources_of, rule_of
from magic_server.audit import AuditEntry, AuditLog
from magic_server.drain import Gate
from magic_server.metrics import Metrics
from magic_server.quotas import Quotas
from magic_server.resources import MEMORY_RETRY_S, Resources
from magic_server.tokens import Principal

logger = logging.getLogger(__name__)

WATCHES = frozenset(("/magicslam.v1.MappingService/WatchCorrectedPoses",))
"""Calls that last as long as their caller wants; they have places of their own."""
_KINDS = ("session", "agent", "submap")
Route = Callable[[str, str], Awaitable[None]]
"""Called with a method and the name of a resource."""


@dataclass(slots=True)
class Call:
    """One call while it is handled."""

    method: str
    rule: Rule
    peer: str
    desk: CallDesk
    principal: Principal | None = None
    resources: tuple[str, ...] = ()
    request_id: str = ""
    trace_id: str = ""
    outcome: tuple[str, str] = ("OK", "")
    """gRPC code and ErrorInfo reason."""

    @property
    def name(self) -> str:
        """The method's short name."""
        return self.method.rpartition("/")[2]

    @property
    def caller(self) -> str:
        """Whose calls are counted together: a known caller's, else those of an address."""
        if self.principal is None or self.principal is ANYBODY:
            return self.peer.rpartition(":")[0]
        return self.principal.name

    def note(self, request: Any) -> None:
        """Remember what a request is about, for logs, traces and the audit log."""
        self.resources = tuple(name[:256] for name in resources_of(self.rule, request))
        source = request.header if _has(request, "header") else request
        self.request_id = getattr(source, "request_id", "")[:128]
        ids = _ids(self.resources)
        logs.bind(**ids)
        tracing.annotate(**ids)

    def authorise(self, request: Any) -> None:
        """Raise unless the caller may make this request."""
        assert self.principal is not None  # set before a request is read
        self.desk.access.require(self.principal, self.method, request)

    async def require_here(self) -> None:
        """Raise HeldElsewhere where another server works on what the call is about."""
        if self.desk.route is not None:
            for name in self.resources:
                await self.desk.route(self.method, name)

    def count(self, answer: Any) -> None:
        """Count what an answer says was stored."""
        if isinstance(answer, mapping_pb.SubmitSubmapResponse) and not answer.duplicate:
            self.desk.metrics.submaps.inc()
            self.desk.metrics.submap_bytes.inc(answer.stored_bytes)

    async def authorised(self, requests: AsyncIterator[Any]) -> AsyncIterator[Any]:
        """The messages of a stream; the first, and each that names something, is authorised."""
        first = True
        async for request in requests:
            if first or resources_of(self.rule, request):
                self.note(request)
                self.authorise(request)
                await self.require_here()
                first = False
            if _has(request, "chunk"):
                self.desk.metrics.received_bytes.inc(len(request.chunk.data))
            yield request


class CallDesk:
    """Receives calls, and keeps count of them."""

    def __init__(
        self,
        *,
        access: AccessControl,
        gate: Gate,
        quotas: Quotas,
        resources: Resources,
        metrics: Metrics,
        audit: AuditLog,
        route: Route | None = None,
    ) -> None:
        """`route` raises for what another server has to be asked; None where there is no other."""
        self.access = access
        self.route = route
        self.metrics = metrics
        self._gate = gate
        self._quotas = quotas
        self._resources = resources
        self._audit = audit

    @contextlib.asynccontextmanager
    async def handling(
        self, method: str, context: grpc.aio.ServicerContext, request: Any = None
    ) -> AsyncIterator[Call]:
        """Around the behaviour of a call; `request` where it has only one.

        What the behaviour raises ends the call with a status that its caller can read.
        """
        started = time.perf_counter()
        call = Call(method, rule_of(method), context.peer(), self)
        parent = _metadata(context, tracing.METADATA_KEY)
        try:
            with tracing.span(f"server {call.name}", parent=parent), self._reported(call):
                call.trace_id = tracing.trace_id() or ""
                if request is not None:
                    call.note(request)
                call.principal = self.access.principal(context)
                self._quotas.call(call.caller)
                with self._gate.passing(watch=method in WATCHES):
                    if call.rule.heavy:
                        await self._resources.require(0)
                    if request is not None:
                        call.authorise(request)
                        await call.require_here()
                    yield call
        except MagicError as error:
            await self._write_audit(call)
            status = grpc_status_of(error)
            await context.abort(status.code, status.details or "", status.trailing_metadata or ())
        except grpc.aio.AbortError:
            raise
        except Exception as error:
            await self._write_audit(call)
            incident = uuid.uuid4().hex[:12]
            logger.error("%s failed, incident %s", method, incident, exc_info=error)
            await context.abort(grpc.StatusCode.INTERNAL, f"internal error, incident {incident}")
        else:
            await self._write_audit(call)
        finally:
            seconds = time.perf_counter() - started
            self.metrics.rpc_seconds.labels(call.name, call.outcome[0]).observe(seconds)

    @contextlib.contextmanager
    def _reported(self, call: Call):
        """Writes down how the call ended, before anything is answered."""
        try:
            yield
        except MemoryError as error:
            call.outcome = MemoryLow.grpc_code, MemoryLow.reason
            self.metrics.refusals.labels(call.name, MemoryLow.reason).inc()
            message = "the server ran out of memory over this call; try again"
            raise MemoryLow(message, retry_after_s=MEMORY_RETRY_S) from error
        except MagicError as error:
            call.outcome = error.grpc_code, error.reason
            self.metrics.refusals.labels(call.name, error.reason).inc()
            tracing.annotate(code=error.grpc_code, reason=error.reason)
            logger.info("%s refused: %s: %s", call.method, error.reason, error.message)
            raise
        except Exception:
            call.outcome = "INTERNAL", "INTERNAL"
            raise
        except BaseException:
            call.outcome = "CANCELLED", ""
            raise

    async def _write_audit(self, call: Call) -> None:
        if not call.rule.mutates:
            return
        code, reason = call.outcome
        principal = "" if call.principal is None else call.principal.name
        entry = AuditEntry(
            principal=principal,
            peer=call.peer,
            method=call.method,
            resources=call.resources,
            request_id=call.request_id,
            code=code,
            reason=reason,
            trace_id=call.trace_id,
        )
        await self._audit.write(entry)


def _ids(resources: tuple[str, ...]) -> dict[str, str]:
    """session, agent and submap of a resource name, as far as it has them."""
    parts = resources[0].split("/")[:6] if resources else []
    # What is no name yet may hold line breaks, which would forge lines of a text log.
    values = (part[:64] if part.isprintable() else ascii(part[:64]) for part in parts[1::2])
    return dict(zip(_KINDS, values, strict=False))


def _has(message: Any, field_name: str) -> bool:
    """Whether a message has a field of this name and it is set."""
    known = field_name in message.DESCRIPTOR.fields_by_name
    return known and message.HasField(field_name)


def _metadata(context: grpc.aio.ServicerContext, key: str) -> str | None:
    for name, value in context.invocation_metadata() or ():
        if name == key:
            return str(value)
    return None
