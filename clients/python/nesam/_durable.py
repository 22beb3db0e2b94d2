"""Measurements that are kept until the service has them on stable storage."""

import math
import time
from collections import deque
from typing import Deque, List, Optional, Tuple

import grpc

from . import _calls as calls
from . import _types as t
from ._errors import DeadlineExceeded, NesamError, Unavailable

_BROKEN = {
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.CANCELLED,
    grpc.StatusCode.UNKNOWN,
    grpc.StatusCode.INTERNAL,
    grpc.StatusCode.DEADLINE_EXCEEDED,
}
"""How a connection looks that broke or fell silent, by itself or through a proxy. Everything else is a refusal."""


class DurableStream:
    """A stream of the measurements of one session that outlives crashes of the server; open it with `client.durable_stream`.

    What is not known to be durable is kept and sent again over a new connection; the service drops what it has. Threads must not share it.
    """

    def __init__(self, client, session_id: str, reconnect_s: float, pause_s: float):
        self._client = client
        self._session_id = session_id
        self._reconnect_s = reconnect_s
        self._pause_s = pause_s
        self._stream = None
        # Each measurement with its place, None before it is answered by this run of the server.
        self._kept: Deque[Tuple[t.Measurement, Optional[int]]] = deque()
        # Who counts the places.
        self._run = 0

    def __enter__(self) -> "DurableStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pending(self) -> List[t.Measurement]:
        """Measurements that are not known to be durable, oldest first."""
        return [measurement for measurement, _ in self._kept]

    def send(self, measurement: t.Measurement) -> t.Answer:
        """Sends one measurement and awaits its answer, over as many connections as it takes.

        Raises Unavailable when the service cannot be reached for `reconnect_s`; the measurement is kept then, and a later `send` or `flush` sends it.
        """
        self._kept.append((measurement, None))
        return self._deliver()[-1]

    def flush(self, timeout_s: float = 10.0) -> None:
        """Waits until everything is durable. Raises DeadlineExceeded after `timeout_s`, also where the server keeps no store, and Unavailable."""
        end = time.monotonic() + timeout_s
        while self._kept:
            if any(place is None for _, place in self._kept):
                try:
                    self._deliver(end)
                except Unavailable:
                    if time.monotonic() < end:
                        raise
            try:
                left_s = max(0.0, min(end - time.monotonic(), self._client.timeout_s))
                session = self._client._do(calls.session(self._session_id), left_s)
                self._durable(session.run, session.durable_place)
            except NesamError as error:
                if error.code not in _BROKEN:
                    raise
                self._forget_places()
            if self._kept and time.monotonic() >= end:
                reason = f"{len(self._kept)} measurements are not durable after {timeout_s} s; is the server there, and does it keep a store?"
                raise DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "", reason)
            if self._kept:
                time.sleep(min(self._pause_s, 0.05))

    def close(self) -> None:
        """Says that no more measurements come; what is not durable is in `pending`."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _deliver(self, end: float = math.inf) -> List[t.Answer]:
        """Sends what has no answer yet, oldest first, over as many connections as it takes until `end`."""
        until = min(end, time.monotonic() + self._reconnect_s)
        while True:
            try:
                return self._attempt(end)
            except NesamError as error:
                self.close()
                self._forget_places()
                if error.code not in _BROKEN:
                    raise
                if time.monotonic() >= until:
                    raise Unavailable(error.code, error.field, error.message) from error
                time.sleep(self._pause_s)

    def _attempt(self, end: float) -> List[t.Answer]:
        if self._stream is None:
            self._stream = self._client.measurement_stream()
        answers = []
        for i, (measurement, place) in enumerate(list(self._kept)):
            if place is not None:
                continue
            answer = self._stream.send(measurement, max(0.0, min(self._reconnect_s, end - time.monotonic())))
            if answer.code in (grpc.StatusCode.RESOURCE_EXHAUSTED.value[0], grpc.StatusCode.UNAVAILABLE.value[0]):
                raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", answer.message)
            # A refusal need not tell who counts.
            if answer.place:
                self._counted_by(answer.run)
            self._kept[i] = (measurement, answer.place)
            answers.append(answer)
        # A place of 0 is that of a refused measurement, which nobody keeps.
        if answers:
            self._durable(self._run, answers[-1].durable_place if answers[-1].run == self._run else 0)
        return answers

    def _durable(self, run: int, durable_place: int) -> None:
        self._counted_by(run)
        self._kept = deque((m, place) for m, place in self._kept if place is None or place > durable_place)

    def _counted_by(self, run: int) -> None:
        if run != self._run:
            self._run = run
            self._forget_places()

    def _forget_places(self) -> None:
        """Another run of the server may count otherwise."""
        self._kept = deque((measurement, None) for measurement, _ in self._kept)
