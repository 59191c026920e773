"""The one error tree of magic-slam.

    MagicError                      UNKNOWN
    ├── InvalidInput                INVALID_ARGUMENT     a value breaks a stated rule
    │   └── ConfigError             INVALID_ARGUMENT     a setting is unknown or out of range
    ├── DataError                   FAILED_PRECONDITION  a dataset is missing or not in its layout
    ├── NotFound                    NOT_FOUND            a named thing does not exist
    │   └── NotLocalized            NOT_FOUND            an image fits no place of the map
    ├── AlreadyExists               ALREADY_EXISTS       a name is taken by something else
    ├── WrongState                  FAILED_PRECONDITION  the thing exists but cannot do this now
    │   └── DescriptorModelMismatch FAILED_PRECONDITION  another image encoder
    ├── CorruptData                 DATA_LOSS            bytes do not match checksum or format
    ├── ResourceExhausted           RESOURCE_EXHAUSTED   a limit is reached
    │   ├── QuotaExceeded           RESOURCE_EXHAUSTED   the share of an agent or session is used up
    │   ├── RateLimited             RESOURCE_EXHAUSTED   more per second than agreed
    │   ├── Overloaded              RESOURCE_EXHAUSTED   a queue of the server is full
    │   ├── DiskFull                RESOURCE_EXHAUSTED   the server's disk has no room left
    │   └── MemoryLow               RESOURCE_EXHAUSTED   the server's memory has no room left
    ├── Unauthenticated             UNAUTHENTICATED      no token, or a wrong one
    │   └── PlaintextRefused        UNAUTHENTICATED      what came unencrypted must be encrypted
    ├── PermissionDenied            PERMISSION_DENIED    a caller that is known may not do this
    ├── Unavailable                 UNAVAILABLE          try again later
    │   └── HeldElsewhere           UNAVAILABLE          another server works on the session
    ├── DeadlineExceeded            DEADLINE_EXCEEDED    the answer did not come in time
    └── NotSupported                UNIMPLEMENTED        this build or version cannot do it

Each class has one gRPC code and one ErrorInfo reason. `wire.errors` turns them into
google.rpc.Status and back, so that a client catches the same class the server raised. An error
that may pass by waiting says how long (`retry_after_s`, google.rpc.RetryInfo on the wire).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FieldViolation:
    """One field that breaks its rule: a dotted path; value, rule and remedy in a sentence."""

    field: str
    description: str


class MagicError(Exception):
    """Base of every error this project raises on purpose."""

    grpc_code = "UNKNOWN"
    reason = "MAGIC_ERROR"

    def __init__(
        self,
        message: str,
        *,
        violations: tuple[FieldViolation, ...] = (),
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.violations = violations
        self.retry_after_s = retry_after_s

    def __reduce__(self):  # errors cross process borders; keyword-only arguments need help
        return _rebuild, (type(self), self.message, self.violations, self.retry_after_s)


def _rebuild(
    cls: type[MagicError],
    message: str,
    violations: tuple[FieldViolation, ...],
    retry_after_s: float | None,
) -> MagicError:
    return cls(message, violations=violations, retry_after_s=retry_after_s)


class InvalidInput(MagicError):
    grpc_code = "INVALID_ARGUMENT"
    reason = "INVALID_INPUT"

    @classmethod
    def field(cls, name: str, description: str) -> InvalidInput:
        """An error about one field."""
        return cls(f"{name}: {description}", violations=(FieldViolation(name, description),))


class ConfigError(InvalidInput):
    reason = "CONFIG_ERROR"


class DataError(MagicError):
    grpc_code = "FAILED_PRECONDITION"
    reason = "DATA_ERROR"


class NotFound(MagicError):
    grpc_code = "NOT_FOUND"
    reason = "NOT_FOUND"


class NotLocalized(NotFound):
    reason = "NOT_LOCALIZED"


class AlreadyExists(MagicError):
    grpc_code = "ALREADY_EXISTS"
    reason = "ALREADY_EXISTS"


class WrongState(MagicError):
    grpc_code = "FAILED_PRECONDITION"
    reason = "WRONG_STATE"


class DescriptorModelMismatch(WrongState):
    reason = "DESCRIPTOR_MODEL_MISMATCH"


class CorruptData(MagicError):
    grpc_code = "DATA_LOSS"
    reason = "CORRUPT_DATA"


class ResourceExhausted(MagicError):
    grpc_code = "RESOURCE_EXHAUSTED"
    reason = "RESOURCE_EXHAUSTED"


class QuotaExceeded(ResourceExhausted):
    reason = "QUOTA_EXCEEDED"


class RateLimited(ResourceExhausted):
    reason = "RATE_LIMITED"


class Overloaded(ResourceExhausted):
    reason = "OVERLOADED"


class DiskFull(ResourceExhausted):
    reason = "DISK_FULL"


class MemoryLow(ResourceExhausted):
    reason = "MEMORY_LOW"


class Unauthenticated(MagicError):
    grpc_code = "UNAUTHENTICATED"
    reason = "UNAUTHENTICATED"


class PlaintextRefused(Unauthenticated):
    reason = "PLAINTEXT_REFUSED"


class PermissionDenied(MagicError):
    grpc_code = "PERMISSION_DENIED"
    reason = "PERMISSION_DENIED"


class Unavailable(MagicError):
    grpc_code = "UNAVAILABLE"
    reason = "UNAVAILABLE"


class HeldElsewhere(Unavailable):
    reason = "HELD_ELSEWHERE"

    def __init__(
        self,
        message: str,
        *,
        holder: str = "",
        violations: tuple[FieldViolation, ...] = (),
        retry_after_s: float | None = None,
    ) -> None:
        """`holder` is the HOST:PORT of the server to ask instead; empty while nobody has it."""
        super().__init__(message, violations=violations, retry_after_s=retry_after_s)
        self.holder = holder

    def __reduce__(self):
        return _rebuild_held, (self.message, self.holder, self.violations, self.retry_after_s)


def _rebuild_held(
    message: str,
    holder: str,
    violations: tuple[FieldViolation, ...],
    retry_after_s: float | None,
) -> HeldElsewhere:
    return HeldElsewhere(message, holder=holder, violations=violations, retry_after_s=retry_after_s)


class DeadlineExceeded(MagicError):
    grpc_code = "DEADLINE_EXCEEDED"
    reason = "DEADLINE_EXCEEDED"


class NotSupported(MagicError):
    grpc_code = "UNIMPLEMENTED"
    reason = "NOT_SUPPORTED"
