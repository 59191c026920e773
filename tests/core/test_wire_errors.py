"""Errors cross the wire as the class that was raised."""

from __future__ import annotations

import pickle

import grpc
import pytest
from grpc_status import rpc_status

from magic_core import errors
from magic_core.errors import FieldViolation, HeldElsewhere, MagicError
from magic_core.wire import error_of, grpc_status_of, status_of


class FailedCall(grpc.RpcError):
    """A call that ended with a status, as a client sees it."""

    def __init__(self, code, details, metadata) -> None:
        self._answer = code, details, metadata

    def code(self):
        return self._answer[0]

    def details(self):
        return self._answer[1]

    def trailing_metadata(self):
        return self._answer[2]


def all_classes(kind: type[MagicError] = MagicError) -> list[type[MagicError]]:
    """Every error of the public tree; what else derives from them never leaves its process."""
    below = [sub for sub in kind.__subclasses__() if sub.__module__ == errors.__name__]
    return [kind, *(found for sub in below for found in all_classes(sub))]


@pytest.mark.parametrize("kind", all_classes())
def test_every_error_comes_back_as_itself(kind: type[MagicError]) -> None:
    violations = (FieldViolation("camera.fx", "must be > 0"), FieldViolation("depth", "is NaN"))
    raised = kind("the message", violations=violations)
    status = grpc_status_of(raised)
    assert status.code.name == kind.grpc_code
    caught = error_of(FailedCall(status.code, status.details, status.trailing_metadata))
    assert type(caught) is kind
    assert (caught.message, caught.violations) == (raised.message, violations)


def test_an_error_of_one_process_alone_comes_back_as_its_public_kind() -> None:
    class Private(errors.Unavailable):
        pass

    status = grpc_status_of(Private("the message"))
    caught = error_of(FailedCall(status.code, status.details, status.trailing_metadata))
    assert type(caught) is errors.Unavailable
    assert caught.message == "the message"


def test_the_server_to_ask_instead_crosses_the_wire_and_process_borders() -> None:
    raised = HeldElsewhere("the session is elsewhere", holder="other:50051")
    status = grpc_status_of(raised)
    caught = error_of(FailedCall(status.code, status.details, status.trailing_metadata))
    for one in (caught, pickle.loads(pickle.dumps(raised))):
        assert isinstance(one, HeldElsewhere)
        assert (one.message, one.holder) == (raised.message, "other:50051")


def test_how_long_to_wait_crosses_the_wire() -> None:
    status = grpc_status_of(errors.RateLimited("slow down", retry_after_s=1.25))
    caught = error_of(FailedCall(status.code, status.details, status.trailing_metadata))
    assert caught.retry_after_s == 1.25
    retry = rpc_status.from_call(FailedCall(*status[:3])).details[-1]  # type: ignore[arg-type]
    assert retry.type_url == "type.googleapis.com/google.rpc.RetryInfo"


def test_a_status_reads_as_google_rpc_status() -> None:
    error = errors.InvalidInput.field("odometry", "is bent")
    parsed = rpc_status.from_call(FailedCall(*grpc_status_of(error)[:3]))  # type: ignore[arg-type]
    assert parsed == status_of(error)
    assert [detail.type_url.rpartition(".")[2] for detail in parsed.details] == [
        "ErrorInfo",
        "BadRequest",
    ]


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (grpc.StatusCode.UNAVAILABLE, errors.Unavailable),
        (grpc.StatusCode.DEADLINE_EXCEEDED, errors.DeadlineExceeded),
        (grpc.StatusCode.UNIMPLEMENTED, errors.NotSupported),
        (grpc.StatusCode.INTERNAL, MagicError),
    ],
)
def test_a_bare_status_goes_by_its_code(code: grpc.StatusCode, kind: type[MagicError]) -> None:
    caught = error_of(FailedCall(code, "text", ()))
    assert type(caught) is kind
    assert "text" in caught.message


def test_damaged_details_do_not_hide_the_code() -> None:
    metadata = (("grpc-status-details-bin", b"\xff\xff\xff"),)
    caught = error_of(FailedCall(grpc.StatusCode.NOT_FOUND, "text", metadata))
    assert type(caught) is errors.NotFound
