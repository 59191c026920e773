"""One connection: its deadlines, which calls are tried again, and pages."""

from __future__ import annotations

import asyncio
import contextlib
import random
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, TypeVar

import grpc
import grpc.aio
from grpc_health.v1 import health_pb2, health_pb2_grpc
from magicslam.v1 import global_map_service_pb2_grpc as map_grpc
from magicslam.v1 import mapping_service_pb2_grpc as mapping_grpc
from magicslam.v1 import session_service_pb2_grpc as session_grpc

from magic_agent.client.targets import Targets
from magic_core.errors import MagicError, Unavailable
from magic_core.wire import (
    ClientCredentials,
    SubmapEncoding,
    Transport,
    error_of,
)

_T = TypeVar("_T")
TURNS = 50
"""Attempts at least where there are several servers."""
TURN_S = 0.5
"""Longest wait between them, seconds."""


@dataclass(frozen=True, slots=True)
class ClientConfig:
    """Deadlines and retries of a client."""

    connect_timeout_s: float = 20.0
    """How long `connect` waits for the server."""
    rpc_timeout_s: float = 20.0
    """Deadline of one ordinary call, seconds."""
    localize_timeout_s: float = 180.0
    """Deadline of placing one image in the map, seconds; the first also waits for a worker."""
    submit_timeout_s: float = 300.0
    """Deadline of one attempt to send a sub-map, seconds."""
    download_timeout_s: float = 600.0
    """Deadline of one download, seconds."""
    watch_timeout_s: float = 3600.0
    """A watch is opened again after this long, seconds; nothing is missed."""
    attempts: int = 5
    """Times an idempotent call is tried while the server cannot be reached."""
    backoff_s: float = 0.25
    """Wait before the second attempt, seconds; doubles each time, with jitter."""
    max_backoff_s: float = 10.0
    """Longest wait between attempts, seconds, unless the server asks for a longer one."""
    max_asked_s: float = 30.0
    """A server that asks for a longer wait than this has its refusal raised at once, seconds."""
    encoding: SubmapEncoding = field(default_factory=SubmapEncoding)
    """How sub-maps become bytes."""
    credentials: ClientCredentials = field(default_factory=ClientCredentials)
    """Encryption and token."""
    transport: Transport = field(default_factory=Transport)
    """Keepalive and message limits."""


class Connection:
    """A connection to a server, or to those of several that work on what is asked.

    `target` is HOST:PORT, or several with commas between them: servers that share a database. Calls
    follow a session from server to server.
    """

    def __init__(self, target: str, config: ClientConfig = ClientConfig()) -> None:
        self.target = target
        self._closed = False
        self.config = config
        opened: Any = Targets(target, credentials=config.credentials, transport=config.transport)
        self._targets: Targets = opened
        self.mapping_stub = mapping_grpc.MappingServiceStub(opened)
        self.map_stub = map_grpc.GlobalMapServiceStub(opened)
        self.session_stub = session_grpc.SessionServiceStub(opened)

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def connect(self) -> None:
        """Wait until the server answers; Unavailable when it does not in time."""
        try:
            async with asyncio.timeout(self.config.connect_timeout_s):
                await self._targets.ready()
        except TimeoutError as error:
            waited = self.config.connect_timeout_s
            raise Unavailable(
                f"no server answers at {self.target} within {waited:g} s; is `magic serve` "
                f"running, with the encryption that this client has? {await self._diagnosis()}"
            ) from error

    async def _diagnosis(self) -> str:
        """What gRPC says of the connection: a refused port, or a certificate and what is wrong."""
        try:
            await health_pb2_grpc.HealthStub(self._targets.channel).Check(
                health_pb2.HealthCheckRequest(), timeout=2.0
            )
        except grpc.aio.AioRpcError as failure:
            return f"({failure.details()})"
        return ""

    async def close(self) -> None:
        """Close the connection; calls under way are cancelled."""
        self._closed = True
        await self._targets.close()

    async def idempotent(
        self,
        method: Callable[..., Awaitable[_T]],
        request: Any,
        *,
        timeout_s: float | None = None,
    ) -> _T:
        """The answer of a call that may be repeated: it gets a deadline and is tried again."""

        async def attempt() -> _T:
            return await method(request, timeout=timeout_s or self.config.rpc_timeout_s)

        return await self.retried(attempt)

    async def retried(self, attempt: Callable[[], Awaitable[_T]]) -> _T:
        """The result of an attempt, made again while the server cannot be reached."""
        failures = 0
        while True:
            try:
                with self.own_errors():
                    return await attempt()
            except MagicError as error:
                await self.pause_or_raise(error, failures)
            failures += 1

    @contextlib.contextmanager
    def own_errors(self) -> Iterator[None]:
        """Raise our errors for those of gRPC.

        When a connection breaks at a bad moment gRPC raises CancelledError, as if this task had
        been cancelled; a task group around it would then end without a word.
        """
        try:
            yield
        except grpc.RpcError as failure:
            raise error_of(failure) from failure
        except asyncio.CancelledError as failure:
            task = asyncio.current_task()
            if self._closed or task is None or task.cancelling():
                raise
            raise Unavailable("the connection broke during the call") from failure

    async def pause_or_raise(self, error: MagicError, failures: int) -> None:
        """Sleep before the next attempt, or raise when trying again is no use.

        A server that refuses for now says how long, and is left alone for that.
        """
        asked_s = error.retry_after_s
        passing = isinstance(error, Unavailable) or asked_s is not None
        at_once = self._targets.turn(error)
        several = self._targets.several
        attempts = self.config.attempts
        if several:  # a lost server's sessions are with another after some seconds
            attempts = max(attempts, TURNS)
        if not passing or failures + 1 >= attempts:
            raise error
        if at_once:
            return
        if asked_s is not None and asked_s > self.config.max_asked_s:
            raise error
        pause = min(self.config.backoff_s * 2**failures, self.config.max_backoff_s)
        if several:
            pause = min(pause, TURN_S)
        pause *= random.uniform(0.5, 1.0)
        # A little later than asked: of many who wait, not all come back in the same instant.
        await asyncio.sleep(max(pause, (asked_s or 0.0) * random.uniform(1.0, 1.2)))

    async def pages(self, method: Callable[..., Awaitable[_T]], request: Any) -> AsyncIterator[_T]:
        """Every page of a list call."""
        while True:
            page: Any = await self.idempotent(method, request)
            yield page
            if not page.next_page_token:
                return
            request.page_token = page.next_page_token


def new_id() -> str:
    """A request id that nobody else chooses."""
    return uuid.uuid4().hex
