"""Measurements that are kept until the service has them on stable storage."""

import math
import time

from . import _calls as calls
from . import _types as t
from ._errors import NesamError, Unavailable
from ._kept import KeepingStream


class DurableStream(KeepingStream):
    """A stream of the measurements of one session that outlives crashes of the server; open it with `client.durable_stream`.

    What is not known to be durable is kept, at most `pending_max` measurements, and sent again over a new connection; the service drops what it has.
    Where the session was closed and opened again, all that is kept is sent to the new one, the oldest first. One thing is lost then: who opens it from another
    client between two measurements is noticed only by the answer to the next, and the new session takes nothing before that but what lies within its reorder
    window; `send` or `flush` raise Refused with the rest.
    Measurements without a number or a boot get one of this program, so that nothing is taken for new that is sent again. Threads must not share it.
    """

    def __enter__(self) -> "DurableStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, measurement: t.Measurement) -> t.Answer:
        """Sends one measurement and awaits its answer, over as many connections as it takes. Where the session is not open the answer is REJECTED (code 5 for
        `session_id`) and the measurement is kept: whoever opens the session gets all that is kept, the oldest first.

        Raises Refused where older measurements that were kept have been refused now: the answer to this one is in its `answer`. Raises Unavailable when the service
        cannot be reached for `reconnect_s`; the measurement is kept then, and a later `send` or `flush` sends it. Raises Overloaded of `pending_max` when so many are
        kept: this one is not, `flush` first. Raises ValueError for an array of a wrong shape, another session, or numbers that some measurements have and some have
        not; such a one is not kept.
        """
        self._keep(measurement)
        answer = self._deliver()
        self._kept.tell_refused(answer)
        return answer

    def flush(self, timeout_s: float = 10.0) -> None:
        """Waits until everything is durable. Raises DeadlineExceeded after `timeout_s`, also where the server keeps no store, Unavailable, NotFound where the session
        is not open (all is kept), and, when the rest is durable, Refused where something that was kept has been refused."""
        end = time.monotonic() + timeout_s
        while self._kept:
            self._look()
            if self._kept.next:
                try:
                    self._deliver(end)
                except Unavailable:
                    if time.monotonic() < end:
                        raise
            try:
                left_s = max(0.0, min(end - time.monotonic(), self._client.timeout_s))
                if not self._kept.told(self._client._do(calls.session(self._session_id), left_s)):
                    self.close()
            except NesamError as error:
                self._kept.unheard(error)
            if self._kept and time.monotonic() >= end:
                raise self._kept.overdue(timeout_s)
            if self._kept:
                time.sleep(min(self._pause_s, 0.05))
        self._kept.tell_refused()

    def close(self) -> None:
        """Ends the connection; what is not durable stays in `pending`, and a later `send` or `flush` sends it over another one."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        self._kept.forget_places()

    def _deliver(self, end: float = math.inf) -> t.Answer:
        """Sends what has no answer yet, oldest first, over as many connections as it takes until `end`; the answer to the newest."""
        until = min(end, time.monotonic() + self._reconnect_s)
        while True:
            try:
                return self._attempt(end)
            except NesamError as error:
                self.close()
                self._failed(error)
                left_s = until - time.monotonic()
                if left_s <= 0.0:
                    raise Unavailable(error.code, error.field, error.message, error.retry_after_s) from error
                time.sleep(min(left_s, self._until_again_s(error)))
            except BaseException:
                # Interrupted before its answer, which must not be taken for that of the next measurement.
                self.close()
                raise

    def _attempt(self, end: float) -> t.Answer:
        """The same over one connection, each measurement after the answer to the one before."""
        self._look()
        if self._stream is None:
            self._stream = self._client.measurement_stream()
        while True:
            answer: t.Answer = self._stream.send(self._kept.next, max(0.0, min(self._reconnect_s, end - time.monotonic())))
            told = self._kept.answered(answer)
            if told is not None:
                return told
