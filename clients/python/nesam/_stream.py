"""What measurement streams have in common, however their answers are waited for.

Threads of gRPC carry both kinds: grpc.aio forgets why a stream ended that was written to at that moment.
"""

import queue
import threading
import time
import warnings
from collections import deque
from typing import Any, Callable, Deque, Iterable, Optional

import grpc

from . import _calls as calls
from . import _messages as m
from . import _types as t
from ._connection import finite_timeout
from ._errors import DeadlineExceeded, NesamError, Unavailable
from .v1 import measurements_pb2


ON_THE_WAY_MAX = 256
"""Measurements of an exchange that have been sent and whose answers have not been taken; as many as a service takes from one stream by default
(`grpc.measurements_in_flight_max`)."""


class OpenStream:
    """One open stream. hear: takes every answer, and then the NesamError that says what ended the stream; it is called from another thread. A stream that nobody
    has closed ends with its object, with a ResourceWarning: the service allows a connection no more than some hundred."""

    def __init__(self, client: Any, hear: Callable[[Any], None]):
        self._closed = True
        self._client = client
        self._outgoing: "queue.SimpleQueue[Optional[measurements_pb2.Measurement]]" = queue.SimpleQueue()
        self._waiting: Deque[calls.Reported] = deque()
        # Since when the oldest of those that wait has been waited for.
        self._since = 0.0
        self._ended: Optional[NesamError] = None
        try:
            self._call = client._open_measurements(iter(self._outgoing.get, None))
        except ValueError as error:
            raise client._refusal(error) from None
        self._closed = False
        threading.Thread(target=_listen, args=(self._call, hear, client._refusal), daemon=True).start()

    def __del__(self) -> None:
        if not getattr(self, "_closed", True):
            warnings.warn("a measurement stream was not closed; use it in a `with` block", ResourceWarning, stacklevel=2, source=self)
            # No more than that: it may come in the middle of anything, also of `KnownStates`.
            self._call.cancel()
            self._outgoing.put(None)

    def _put(self, measurement: t.Measurement) -> None:
        """Sends one. Raises what ended the stream where that has been heard, ValueError for an array of a wrong shape."""
        message = m.measurement_message(measurement)
        reported = self._client._known_states.report(measurement)
        if self._ended is not None or self._closed:
            self._client._known_states.unheard(reported)
            raise self._ended or Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the measurement stream is closed")
        if not self._waiting:
            self._since = time.monotonic()
        self._waiting.append(reported)
        self._outgoing.put(message)

    def _left_s(self, timeout_s: float) -> Optional[float]:
        """How long the oldest answer may still take; None = for ever."""
        return finite_timeout(max(0.0, self._since + timeout_s - time.monotonic()))

    def _late(self, timeout_s: float) -> NesamError:
        """The error of an answer that did not come in time, which ends the stream."""
        self._cancel()
        return DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "", f"no answer to a measurement in {timeout_s:.3g} s")

    def _answer(self, heard: Any) -> t.Answer:
        """The answer to the oldest measurement that waits for one. Raises what ended the stream."""
        if isinstance(heard, NesamError):
            self._ended = heard
            self._leave()
            raise heard
        answer, self._since = m.answer(heard), time.monotonic()
        self._client._known_states.measured(self._waiting.popleft(), answer)
        return answer

    def _cancel(self) -> None:
        """Leaves the stream at once; what has no answer gets none, which must not be taken for that of another measurement."""
        self._call.cancel()
        self._leave()

    def _leave(self) -> None:
        """Ends it, with what waits unheard."""
        # While another thread may still send.
        while self._waiting:
            self._client._known_states.unheard(self._waiting.popleft())
        self._say_end()

    def _say_end(self) -> None:
        """Says that no more measurements come."""
        if not self._closed:
            self._closed = True
            self._outgoing.put(None)


def _listen(call: Iterable[measurements_pb2.MeasurementAnswer], hear: Callable[[Any], None], refusal: Callable[[Exception], Exception]) -> None:
    """Tells every answer on a stream, and then what ended it."""
    try:
        for message in call:
            hear(message)
        hear(Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the service ended the measurement stream"))
    except grpc.RpcError as error:
        hear(refusal(error))
