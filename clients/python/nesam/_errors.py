"""Errors: one class for each kind of refusal."""

from typing import TYPE_CHECKING, Any, Dict, Optional, Sequence, Tuple, Union, cast

import grpc
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

if TYPE_CHECKING:
    from ._types import Answer, Measurement


class NesamError(Exception):
    """A call failed. `code` is the gRPC code, `field` the path of the field at fault ("" when none is), `message` what was wrong. retry_after_s: pause after
    which the service may have room or be there again, s, as it says itself; None = it does not say.
    """

    def __init__(self, code: grpc.StatusCode, field: str, message: str, retry_after_s: Optional[float] = None):
        super().__init__(f"{code.name}: {message}")
        self.code = code
        self.field = field
        self.message = message
        self.retry_after_s = retry_after_s

    def __reduce__(self) -> Tuple[Any, ...]:
        """By its arguments: it travels between processes, as out of a pool of workers."""
        return type(self), (self.code, self.field, self.message, self.retry_after_s)


class InvalidArgument(NesamError):
    """A value is not acceptable; `field` says which."""


class NotFound(NesamError):
    """The session or map is not known."""


class AlreadyExists(NesamError):
    """The session or map is there already."""


class FailedPrecondition(NesamError):
    """The session cannot answer as it is: it has no measurement yet, or none that is new enough for `start_stamp_ns`."""


class Overloaded(NesamError):
    """Too many requests wait, or a limit on sessions, maps or what a durable stream keeps is reached; ask again later, where the service says when after `retry_after_s`."""


class DeadlineExceeded(NesamError):
    """No answer came in time."""


class Refused(NesamError):
    """Measurements that a durable stream had kept were refused when it sent them, so that the session does not have them: `refused`, pairs of measurement and
    answer, oldest first. `answer` is the one to the newest measurement, where `send` raises this; that one is as good as if nothing had been raised.
    """

    def __init__(self, refused: "Sequence[Tuple[Measurement, Answer]]", answer: "Optional[Answer]" = None):
        oldest, first = refused[0]
        reason = f"{len(refused)} kept measurements were refused; the oldest is of stamp_ns {oldest.stamp_ns}, number {oldest.sequence}: {first.outcome}"
        super().__init__(grpc.StatusCode.DATA_LOSS, first.field, f"{reason} {first.message}".rstrip())
        self.refused = list(refused)
        self.answer = answer

    def __reduce__(self) -> Tuple[Any, ...]:
        return type(self), (self.refused, self.answer)


class Unavailable(NesamError):
    """The service cannot be reached or is shutting down, or the client is closed."""


_CLASSES = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidArgument,
    grpc.StatusCode.OUT_OF_RANGE: InvalidArgument,
    grpc.StatusCode.NOT_FOUND: NotFound,
    grpc.StatusCode.ALREADY_EXISTS: AlreadyExists,
    grpc.StatusCode.FAILED_PRECONDITION: FailedPrecondition,
    grpc.StatusCode.RESOURCE_EXHAUSTED: Overloaded,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceeded,
    grpc.StatusCode.UNAVAILABLE: Unavailable,
}


# How the server's transport says that the time the client gave was over, where it notices before engine and client do.
_TIME_IS_OVER = (grpc.StatusCode.CANCELLED, "Timeout expired")


def from_rpc(error: grpc.RpcError) -> NesamError:
    """The error class for a failed call."""
    code = error.code()
    if (code, error.details()) == _TIME_IS_OVER:
        code = grpc.StatusCode.DEADLINE_EXCEEDED
    # A tuple first: old metadata of grpc.aio are pairs that `dict` takes for keys.
    metadata: Dict[str, Union[str, bytes]] = dict(cast(Any, tuple(error.trailing_metadata() or ())))
    field = metadata.get("nesam-field", "")
    field = field.decode() if isinstance(field, bytes) else field
    retry_after_s = _retry_after_s(metadata.get("grpc-status-details-bin", b""))
    return _CLASSES.get(code, NesamError)(code, field, error.details() or "", retry_after_s)


def _retry_after_s(details: Union[str, bytes]) -> Optional[float]:
    """What google.rpc.RetryInfo says in the details of a status; None where it is not there, or they are none."""
    try:
        status = status_pb2.Status.FromString(details if isinstance(details, bytes) else b"")
        retry = error_details_pb2.RetryInfo()
        # `Unpack` says whether it is one.
        found = next((True for detail in status.details if detail.Unpack(retry)), False)
    except DecodeError:
        return None
    return retry.retry_delay.seconds + 1e-9 * retry.retry_delay.nanos if found else None
