"""Errors of the service on their way out: ours as rich statuses, all others as INTERNAL."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Awaitable, Callable
from typing import Any

import grpc
import grpc.aio

from magic_core.errors import MagicError
from magic_core.wire import grpc_status_of

logger = logging.getLogger(__name__)


class ErrorInterceptor(grpc.aio.ServerInterceptor):
    """Turns what a servicer raises into what a client can read."""

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """Wrap the behaviour of the method that is being called."""
        handler: Any = await continuation(handler_call_details)
        method = handler_call_details.method
        if handler is None or not method.startswith("/magicslam."):
            return handler
        kind, make = _KINDS[handler.request_streaming, handler.response_streaming]
        wrap = _guarded_stream if handler.response_streaming else _guarded_call
        return make(
            wrap(getattr(handler, kind), method),
            request_deserializer=handler.request_deserializer,
            response_serializer=handler.response_serializer,
        )


_KINDS: dict[tuple[bool, bool], tuple[str, Any]] = {
    (False, False): ("unary_unary", grpc.unary_unary_rpc_method_handler),
    (False, True): ("unary_stream", grpc.unary_stream_rpc_method_handler),
    (True, False): ("stream_unary", grpc.stream_unary_rpc_method_handler),
    (True, True): ("stream_stream", grpc.stream_stream_rpc_method_handler),
}


def _guarded_call(behaviour: Callable[..., Any], method: str) -> Callable[..., Any]:
    async def call(request: Any, context: grpc.aio.ServicerContext) -> Any:
        try:
            return await behaviour(request, context)
        except Exception as error:
            await _abort(error, context, method)

    return call


def _guarded_stream(behaviour: Callable[..., Any], method: str) -> Callable[..., Any]:
    async def call(request: Any, context: grpc.aio.ServicerContext) -> Any:
        try:
            async for answer in behaviour(request, context):
                yield answer
        except Exception as error:
            await _abort(error, context, method)

    return call


async def _abort(error: Exception, context: grpc.aio.ServicerContext, method: str) -> None:
    """End the call with the error's status. Raises, as every abort does."""
    if isinstance(error, grpc.aio.AbortError):
        raise error
    if not isinstance(error, MagicError):
        incident = uuid.uuid4().hex[:12]
        logger.error("%s failed, incident %s", method, incident, exc_info=error)
        await context.abort(grpc.StatusCode.INTERNAL, f"internal error, incident {incident}")
    else:
        logger.info("%s refused: %s: %s", method, error.reason, error.message)
        status = grpc_status_of(error)
        await context.abort(status.code, status.details or "", status.trailing_metadata or ())
