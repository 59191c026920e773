"""The error tree as google.rpc.Status and back, so that a client catches what the server raised."""

from __future__ import annotations

import contextlib

import grpc
from google.protobuf import any_pb2, duration_pb2
from google.protobuf.message import DecodeError, Message
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

from magic_core import errors
from magic_core.errors import FieldViolation, HeldElsewhere, MagicError

DOMAIN = "magicslam"
MAX_DETAIL_CHARACTERS = 2000
_BREAKS = ("Internal error from Core", "Received RST_STREAM", "RST_STREAM", "Stream removed")


def status_of(error: MagicError) -> status_pb2.Status:
    """A google.rpc.Status with ErrorInfo; BadRequest for violated fields, RetryInfo for a wait.

    The ErrorInfo of HELD_ELSEWHERE names the server to ask instead: metadata `holder`.
    """
    info = error_details_pb2.ErrorInfo(reason=error.reason, domain=DOMAIN)
    if isinstance(error, HeldElsewhere) and error.holder:
        info.metadata["holder"] = error.holder
    details = [_packed(info)]
    if error.violations:
        bad = error_details_pb2.BadRequest()
        for violation in error.violations:
            bad.field_violations.add(
                field=violation.field, description=violation.description[:MAX_DETAIL_CHARACTERS]
            )
        details.append(_packed(bad))
    if error.retry_after_s is not None:
        delay = duration_pb2.Duration()
        delay.FromNanoseconds(round(error.retry_after_s * 1e9))
        details.append(_packed(error_details_pb2.RetryInfo(retry_delay=delay)))
    return status_pb2.Status(
        code=code_pb2.Code.Value(error.grpc_code),
        message=error.message[:MAX_DETAIL_CHARACTERS],
        details=details,
    )


def grpc_status_of(error: MagicError) -> grpc.Status:
    """The same as the (code, details, trailing metadata) that a servicer aborts with."""
    return rpc_status.to_status(status_of(error))


def error_of(call: grpc.RpcError) -> MagicError:
    """The error that a failed call stands for: by its ErrorInfo reason, else by its gRPC code."""
    code: grpc.StatusCode = call.code()  # type: ignore[attr-defined]
    message = call.details() or code.name  # type: ignore[attr-defined]
    reason, violations, retry_after_s, holder = _details(call)
    kind = error_class(reason, code.name)
    if reason is None and _is_broken(code.name, message):
        kind = errors.Unavailable
    if kind is MagicError and reason is None:
        message = f"{code.name}: {message}"
    if kind is HeldElsewhere:
        return HeldElsewhere(
            message, holder=holder, violations=violations, retry_after_s=retry_after_s
        )
    return kind(message, violations=violations, retry_after_s=retry_after_s)


def _is_broken(code: str, message: str) -> bool:
    """Whether a call failed on its way: gRPC has no one code for a connection that breaks."""
    return code in ("INTERNAL", "UNKNOWN", "CANCELLED") and message.startswith(_BREAKS)


def error_class(reason: str | None, code: str) -> type[MagicError]:
    """The class of an ErrorInfo reason, else of a gRPC code's name, else the base class."""
    return _BY_REASON.get(reason) or _BY_CODE.get(code, MagicError)


def _details(
    call: grpc.RpcError,
) -> tuple[str | None, tuple[FieldViolation, ...], float | None, str]:
    """(ErrorInfo reason, violated fields, seconds to wait, the server to ask instead), as far as
    the status says."""
    reason, violations, retry_after_s, holder = None, (), None, ""
    status = _rich_status(call)
    for detail in status.details if status is not None else ():
        info, bad = error_details_pb2.ErrorInfo(), error_details_pb2.BadRequest()
        retry = error_details_pb2.RetryInfo()
        with contextlib.suppress(DecodeError):
            if detail.Unpack(info) and info.domain == DOMAIN:
                reason, holder = info.reason, info.metadata.get("holder", "")
            elif detail.Unpack(bad):
                violations = tuple(
                    FieldViolation(v.field, v.description) for v in bad.field_violations
                )
            elif detail.Unpack(retry):
                retry_after_s = max(0.0, retry.retry_delay.ToNanoseconds() / 1e9)
    return reason, violations, retry_after_s, holder


def _rich_status(call: grpc.RpcError) -> status_pb2.Status | None:
    """The status in the trailing metadata, where the peer sent one that parses."""
    for key, value in call.trailing_metadata() or ():  # type: ignore[attr-defined]
        if key == "grpc-status-details-bin":
            try:
                return status_pb2.Status.FromString(value)
            except DecodeError:
                return None
    return None


def _packed(message: Message) -> any_pb2.Any:
    packed = any_pb2.Any()
    packed.Pack(message)
    return packed


def _tree(kind: type[MagicError]) -> list[type[MagicError]]:
    return [kind, *(below for sub in kind.__subclasses__() for below in _tree(sub))]


_CLASSES = _tree(MagicError)
_BY_REASON: dict[str | None, type[MagicError]] = {kind.reason: kind for kind in _CLASSES}
_BY_CODE: dict[str, type[MagicError]] = {
    "INVALID_ARGUMENT": errors.InvalidInput,
    "OUT_OF_RANGE": errors.InvalidInput,
    "NOT_FOUND": errors.NotFound,
    "ALREADY_EXISTS": errors.AlreadyExists,
    "FAILED_PRECONDITION": errors.WrongState,
    "ABORTED": errors.WrongState,
    "DATA_LOSS": errors.CorruptData,
    "RESOURCE_EXHAUSTED": errors.ResourceExhausted,
    "UNAUTHENTICATED": errors.Unauthenticated,
    "PERMISSION_DENIED": errors.PermissionDenied,
    "UNAVAILABLE": errors.Unavailable,
    "DEADLINE_EXCEEDED": errors.DeadlineExceeded,
    "UNIMPLEMENTED": errors.NotSupported,
}
