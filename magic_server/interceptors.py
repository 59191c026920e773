"""Puts the call desk between gRPC and the servicers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
import grpc.aio
from google.protobuf.message import DecodeError

from magic_core.errors import InvalidInput, MagicError
from magic_server.access import OPEN_TO_ALL
from magic_server.calls import CallDesk

Context = grpc.aio.ServicerContext

DISCARD_S, DISCARD_MESSAGES = 0.5, 64
"""How long, and how much, is read on of a stream whose answer is known before its end."""


class CallInterceptor(grpc.aio.ServerInterceptor):
    """Hands every call to the desk before its servicer sees it; health alone goes past."""

    def __init__(self, desk: CallDesk) -> None:
        self._desk = desk

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """Wrap the behaviour of the method that is being called."""
        handler: Any = await continuation(handler_call_details)
        method = handler_call_details.method
        if handler is None or method.startswith(OPEN_TO_ALL):
            return handler
        kind, make = _KINDS[handler.request_streaming, handler.response_streaming]
        wrap = self._stream if handler.response_streaming else self._single
        return make(
            wrap(method, getattr(handler, kind), streamed=handler.request_streaming),
            request_deserializer=_lenient(handler.request_deserializer),
            response_serializer=handler.response_serializer,
        )

    def _single(
        self, method: str, behaviour: Callable[..., Any], *, streamed: bool
    ) -> Callable[..., Awaitable[Any]]:
        """A behaviour with one answer; `streamed` says whether its requests are many."""

        async def single(request: Any, context: Context) -> Any:
            async with self._desk.handling(method, context, _whole(request, streamed)) as call:
                if not streamed:
                    answer = await behaviour(_require(request), context)
                else:
                    answer = await _answered(behaviour, call.authorised, request, context)
                call.count(answer)
                return answer

        return single

    def _stream(
        self, method: str, behaviour: Callable[..., AsyncIterator[Any]], *, streamed: bool
    ) -> Callable[..., Awaitable[None]]:
        """A behaviour with many answers. It writes them instead of yielding, so that a caller
        that goes away ends it at once and in its own task."""

        async def stream(request: Any, context: Context) -> None:
            async with self._desk.handling(method, context, _whole(request, streamed)) as call:
                given = call.authorised(_readable(request)) if streamed else _require(request)
                async for answer in behaviour(given, context):
                    await context.write(answer)

        return stream


class Unreadable:
    """What came in place of a message: bytes that do not parse."""


def _lenient(parse: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """A parser for gRPC, which calls it INTERNAL when one fails, though the caller is to blame."""

    def parsed(data: bytes) -> Any:
        try:
            return parse(data)
        except DecodeError:
            return Unreadable()

    return parsed


def _whole(request: Any, streamed: bool) -> Any:
    """The one request of a call; None where there are many, or what came is none."""
    return None if streamed or isinstance(request, Unreadable) else request


def _require(request: Any) -> Any:
    if isinstance(request, Unreadable):
        raise InvalidInput("the request's bytes are not its message; is the contract the same?")
    return request


async def _readable(requests: AsyncIterator[Any]) -> AsyncIterator[Any]:
    """The messages of a stream; InvalidInput at the first that does not parse."""
    async for request in requests:
        yield _require(request)


async def _answered(
    behaviour: Callable[..., Any],
    authorised: Callable[[AsyncIterator[Any]], AsyncIterator[Any]],
    requests: AsyncIterator[Any],
    context: Context,
) -> Any:
    """The answer to a stream; given, or refused, once the caller has sent what it was sending."""
    try:
        answer = await behaviour(authorised(_readable(requests)), context)
    except MagicError:
        await _discarded(requests)
        raise
    await _discarded(requests)
    return answer


async def _discarded(requests: AsyncIterator[Any]) -> None:
    """Read on for a moment.

    The connection of a caller that is cut off while it sends may lose the answer: gRPC tells it of
    an "Internal error from Core" instead.
    """
    count = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(DISCARD_S):
            async for _ in requests:
                count += 1
                if count == DISCARD_MESSAGES:
                    return


_KINDS: dict[tuple[bool, bool], tuple[str, Any]] = {
    (False, False): ("unary_unary", grpc.unary_unary_rpc_method_handler),
    (False, True): ("unary_stream", grpc.unary_stream_rpc_method_handler),
    (True, False): ("stream_unary", grpc.stream_unary_rpc_method_handler),
    (True, True): ("stream_stream", grpc.stream_stream_rpc_method_handler),
}
