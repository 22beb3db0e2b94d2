"""Measurements that are kept until the service has them on stable storage."""

import itertools
import math
import secrets
import time
from collections import deque
from dataclasses import replace
from typing import Deque, Dict, Iterator, List, Optional, Tuple

import grpc
import numpy as np

from . import _calls as calls
from . import _messages as m
from . import _types as t
from ._errors import DeadlineExceeded, NesamError, Overloaded, Unavailable

_BROKEN = {
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.CANCELLED,
    grpc.StatusCode.UNKNOWN,
    grpc.StatusCode.INTERNAL,
    grpc.StatusCode.DEADLINE_EXCEEDED,
}
"""How a connection looks that broke or fell silent, by itself or through a proxy. Everything else is a refusal."""


_BOOT_ID = secrets.randbits(63) | 1
_NUMBERS: Dict[str, Iterator[int]] = {}
"""This start of the program, and by session the numbers of its measurements that have none of their own: by them the service knows what it has had, however long ago."""


def _kept_copy(measurement: t.Measurement, session_id: str) -> t.Measurement:
    """A measurement as it is now, with a number and a boot: whoever sent it may write its arrays anew before it is sent again."""
    copied = {
        name: None if getattr(measurement, name) is None else np.array(getattr(measurement, name), dtype=np.float64)
        for name in ("state", "wheel_speed_rad_s", "road_wheel_angle_rad")
    }
    number = measurement.sequence or next(_NUMBERS.setdefault(session_id, itertools.count(1)))
    command = (float(measurement.command[0]), float(measurement.command[1]))
    # Which run counts is the matter of the stream.
    return replace(measurement, **copied, command=command, sequence=number, boot_id=measurement.boot_id or _BOOT_ID, run=0)


class DurableStream:
    """A stream of the measurements of one session that outlives crashes of the server; open it with `client.durable_stream`.

    What is not known to be durable is kept, at most `pending_max` measurements, and sent again over a new connection; the service drops what it has.
    Measurements without a number or a boot get one of this program, so that nothing is taken for new that is sent again. Threads must not share it.
    """

    def __init__(self, client, session_id: str, reconnect_s: float, pause_s: float, pending_max: int):
        self._client = client
        self._session_id = session_id
        self._reconnect_s = reconnect_s
        self._pause_s = pause_s
        self._pending_max = pending_max
        self._stream = None
        # What is kept, oldest first: all that is answered is older than all that waits. Durable ones leave from the left, as places only rise.
        self._answered: Deque[Tuple[t.Measurement, int]] = deque()
        # Without an answer of this run of the server.
        self._waiting: Deque[t.Measurement] = deque()
        # Who counts the places.
        self._run = 0
        # Whether measurements come with numbers; None before the first.
        self._is_numbered: Optional[bool] = None

    def __enter__(self) -> "DurableStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pending(self) -> List[t.Measurement]:
        """Measurements that are not known to be durable, oldest first."""
        return [measurement for measurement, _ in self._answered] + list(self._waiting)

    def send(self, measurement: t.Measurement) -> t.Answer:
        """Sends one measurement and awaits its answer, over as many connections as it takes.

        Raises Unavailable when the service cannot be reached for `reconnect_s`; the measurement is kept then, and a later `send` or `flush` sends it. Raises
        Overloaded of `pending_max` when so many are kept: this one is not, `flush` first. Raises ValueError for an array of a wrong shape, another session, or numbers
        that some measurements have and some have not; such a one is not kept.
        """
        kept = self._kept()
        if kept >= self._pending_max:
            reason = f"{kept} measurements are not known to be durable; flush them first"
            raise Overloaded(grpc.StatusCode.RESOURCE_EXHAUSTED, "pending_max", reason)
        # One that cannot be sent would hold up all that come after it.
        m.measurement_message(measurement)
        if measurement.session_id != self._session_id:
            raise ValueError(f"the measurement is of session `{measurement.session_id}`, this stream is of `{self._session_id}`")
        self._is_numbered = self._agrees(measurement)
        measurement = _kept_copy(measurement, self._session_id)
        self._waiting.append(measurement)
        return self._deliver()

    def flush(self, timeout_s: float = 10.0) -> None:
        """Waits until everything is durable. Raises DeadlineExceeded after `timeout_s`, also where the server keeps no store, and Unavailable."""
        end = time.monotonic() + timeout_s
        while self._kept():
            if self._waiting:
                try:
                    self._deliver(end)
                except Unavailable:
                    if time.monotonic() < end:
                        raise
            try:
                left_s = max(0.0, min(end - time.monotonic(), self._client.timeout_s))
                session = self._client._do(calls.session(self._session_id), left_s)
                if self._counted_by_another(session.run):
                    self.close()
                else:
                    self._durable(session.run, session.durable_place)
            except NesamError as error:
                if error.code not in _BROKEN:
                    raise
                # Who is only late may have everything.
                if error.code != grpc.StatusCode.DEADLINE_EXCEEDED:
                    self._forget_places()
            if self._kept() and time.monotonic() >= end:
                reason = f"{self._kept()} measurements are not durable after {timeout_s} s; is the server there, and does it keep a store?"
                raise DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "", reason)
            if self._kept():
                time.sleep(min(self._pause_s, 0.05))

    def close(self) -> None:
        """Ends the connection; what is not durable stays in `pending`, and a later `send` or `flush` sends it over another one."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        self._forget_places()

    def _agrees(self, measurement: t.Measurement) -> bool:
        """Whether it is numbered, as all of a stream are or none: a number of its own may be one that another got here."""
        numbered = bool(measurement.sequence)
        if self._is_numbered not in (None, numbered):
            raise ValueError("this stream has measurements with and without a number; a `sequence` of 0 is none, numbers begin at 1")
        return numbered

    def _kept(self) -> int:
        return len(self._answered) + len(self._waiting)

    def _deliver(self, end: float = math.inf) -> t.Answer:
        """Sends what has no answer yet, oldest first, over as many connections as it takes until `end`; the answer to the newest."""
        until = min(end, time.monotonic() + self._reconnect_s)
        while True:
            try:
                return self._attempt(end)
            except NesamError as error:
                self.close()
                if error.code not in _BROKEN:
                    raise
                if time.monotonic() >= until:
                    raise Unavailable(error.code, error.field, error.message) from error
                time.sleep(self._pause_s)
            except BaseException:
                # Interrupted before its answer, which must not be taken for that of the next measurement.
                self.close()
                raise

    def _attempt(self, end: float) -> t.Answer:
        """The same over one connection, each measurement after the answer to the one before."""
        if self._stream is None:
            self._stream = self._client.measurement_stream()
        while True:
            answer = self._stream.send(self._waiting[0], max(0.0, min(self._reconnect_s, end - time.monotonic())))
            if answer.code in (grpc.StatusCode.RESOURCE_EXHAUSTED.value[0], grpc.StatusCode.UNAVAILABLE.value[0]):
                raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", answer.message)
            # A refused measurement has no place and is not kept; its answer need not tell who counts.
            if answer.place:
                if self._counted_by_another(answer.run, answer.place):
                    raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", "another run of the server counts now")
                self._run = answer.run
                self._answered.append((self._waiting[0], answer.place))
            self._waiting.popleft()
            if answer.run == self._run:
                self._durable(answer.run, answer.durable_place)
            if not self._waiting:
                return answer

    def _counted_by_another(self, run: int, place: float = math.inf) -> bool:
        """Whether the answers so far came from another run of the server, or from a session that began anew: then all is sent again, from the oldest on."""
        return bool(self._answered) and (run != self._run or place < self._answered[-1][1])

    def _durable(self, run: int, durable_place: int) -> None:
        self._run = run
        while self._answered and self._answered[0][1] <= durable_place:
            self._answered.popleft()

    def _forget_places(self) -> None:
        """Another run of the server may count otherwise."""
        self._waiting.extendleft(measurement for measurement, _ in reversed(self._answered))
        self._answered.clear()
