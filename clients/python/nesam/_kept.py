"""What a durable stream keeps, however its measurements travel."""

import itertools
import secrets
from collections import deque
from dataclasses import dataclass, replace
from typing import Any, Deque, Dict, Iterator, List, Optional, Tuple

import grpc
import numpy as np

from . import _messages as m
from . import _types as t
from ._errors import DeadlineExceeded, NesamError, Overloaded, Refused, Unavailable

BROKEN = {
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
    copied: Dict[str, Any] = {
        name: None if getattr(measurement, name) is None else np.array(getattr(measurement, name), dtype=np.float64)
        for name in ("state", "wheel_speed_rad_s", "road_wheel_angle_rad")
    }
    number = measurement.sequence or next(_NUMBERS.setdefault(session_id, itertools.count(1)))
    command = (float(measurement.command[0]), float(measurement.command[1]))
    # Which run counts is the matter of the stream.
    return replace(measurement, **copied, command=command, sequence=number, boot_id=measurement.boot_id or _BOOT_ID, run=0)


_IS_GONE = (grpc.StatusCode.NOT_FOUND.value[0], "session_id")
"""Code and field of the answer where the session is not open."""


@dataclass
class _One:
    """A measurement that is kept. answer: the last one with a place in the session as it is, None where it has none there."""

    measurement: t.Measurement
    answer: Optional[t.Answer] = None

    @property
    def place(self) -> int:
        return 0 if self.answer is None else self.answer.place


class Kept:
    """The measurements of one session that are not known to be durable, at most `pending_max`."""

    def __init__(self, session_id: str, pending_max: int):
        self._session_id = session_id
        self._pending_max = pending_max
        # What is kept, oldest first: all that is answered is older than all that waits. Durable ones leave from the left, as places only rise.
        self._answered: Deque[_One] = deque()
        # Without an answer of this run of the server.
        self._waiting: Deque[_One] = deque()
        # What was refused, and is not kept any more.
        self._refused: List[Tuple[_One, t.Answer]] = []
        # Who counts the places, and the newest one.
        self._run = 0
        self._place = 0
        # Whether measurements come with numbers; None before the first.
        self._is_numbered: Optional[bool] = None

    def __len__(self) -> int:
        return len(self._answered) + len(self._waiting)

    @property
    def pending(self) -> List[t.Measurement]:
        """Oldest first."""
        return [one.measurement for one in (*self._answered, *self._waiting)]

    @property
    def next(self) -> Optional[t.Measurement]:
        """The oldest that has to be sent; None where all is answered."""
        return self._waiting[0].measurement if self._waiting else None

    def put(self, measurement: t.Measurement) -> None:
        """Keeps one more. Raises Overloaded where there is no room, ValueError where it does not belong here; it is not kept then."""
        if len(self) >= self._pending_max:
            reason = f"{len(self)} measurements are not known to be durable; flush them first"
            raise Overloaded(grpc.StatusCode.RESOURCE_EXHAUSTED, "pending_max", reason)
        # One that cannot be sent would hold up all that come after it.
        m.measurement_message(measurement)
        if measurement.session_id != self._session_id:
            raise ValueError(f"the measurement is of session `{measurement.session_id}`, this stream is of `{self._session_id}`")
        self._is_numbered = self._agrees(measurement)
        self._waiting.append(_One(_kept_copy(measurement, self._session_id)))

    def answered(self, answer: t.Answer) -> Optional[t.Answer]:
        """Notes the answer to `next`, and gives the one that the newest is told where no more have to be sent now: none waits, or the session is not open, for which
        all are kept. Raises Unavailable where the connection is of no more use."""
        one = self._waiting[0]
        if answer.code in (grpc.StatusCode.RESOURCE_EXHAUSTED.value[0], grpc.StatusCode.UNAVAILABLE.value[0]):
            raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", answer.message)
        if (answer.code, answer.field) == _IS_GONE:
            self.begins_anew()
            newest = self._waiting[-1].measurement
            return replace(answer, sequence=newest.sequence, stamp_ns=newest.stamp_ns)
        if one.answer is not None and one.answer.run == answer.run and not answer.code and not answer.place:
            # The session has it, and does not know it again: it is of a boot that has ended. It keeps its place until that is durable, which this answer cannot
            # tell: the session may have begun anew.
            self._answered.append(self._waiting.popleft())
            return None if self._waiting else replace(one.answer, durable_place=answer.durable_place)
        if answer.place:
            # Places only rise, and a duplicate is told that of the newest.
            is_anew = answer.run == self._run and answer.place < self._place + (answer.outcome != "DUPLICATE")
            if is_anew or (self._answered and answer.run != self._run):
                has_before = bool(self._answered)
                self.begins_anew()
                if has_before:
                    # They come first now, and then this one once more, which is there already.
                    self._run, self._place, one.answer = answer.run, answer.place, answer
                    raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", "another run of the server counts now, or the session began anew")
            if answer.outcome == "DUPLICATE" and one.answer is not None and one.answer.run == answer.run:
                answer = replace(one.answer, place=answer.place, durable_place=answer.durable_place)
            self._run, self._place, one.answer = answer.run, answer.place, answer
            self._answered.append(one)
            self._durable(answer.durable_place)
        else:
            # It is not kept. What is durable is that of a session with places: this one may have begun anew.
            self._refused.append((one, answer))
        self._waiting.popleft()
        return None if self._waiting else answer

    def told(self, session: t.Session) -> bool:
        """Notes what the session says is durable; False where another run of the server counts now or the session began anew: all is to be sent again over another
        connection."""
        if self._answered and (session.run != self._run or session.accepted < self._place):
            self.begins_anew()
            return False
        self._durable(session.durable_place)
        return True

    def tell_refused(self, told: Optional[t.Answer] = None) -> None:
        """Raises Refused for what was refused since it was raised last, but for the one with the answer `told`."""
        refused = [(one.measurement, answer) for one, answer in self._refused if answer is not told]
        self._refused.clear()
        if refused:
            raise Refused(refused, told)

    def unheard(self, error: NesamError) -> None:
        """Notes that the session said nothing; raises the error again where it is a refusal."""
        if error.code not in BROKEN:
            raise error
        # Who is only late may have everything.
        if error.code != grpc.StatusCode.DEADLINE_EXCEEDED:
            self.forget_places()

    def overdue(self, timeout_s: float) -> DeadlineExceeded:
        """The error where not all is durable in time."""
        reason = f"{len(self)} measurements are not durable after {timeout_s} s; is the server there, and does it keep a store?"
        return DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "", reason)

    def forget_places(self) -> None:
        """Another run of the server may count otherwise: all is sent again."""
        self._waiting.extendleft(reversed(self._answered))
        self._answered.clear()

    def begins_anew(self) -> None:
        """The session was closed, or began anew: what it had is gone with it, and all is sent again, from the oldest on."""
        self.forget_places()
        self._place = 0
        for one in self._waiting:
            one.answer = None

    def _agrees(self, measurement: t.Measurement) -> bool:
        """Whether it is numbered, as all of a stream are or none: a number of its own may be one that another got here."""
        numbered = bool(measurement.sequence)
        if self._is_numbered not in (None, numbered):
            raise ValueError("this stream has measurements with and without a number; a `sequence` of 0 is none, numbers begin at 1")
        return numbered

    def _durable(self, durable_place: int) -> None:
        while self._answered and self._answered[0].place <= durable_place:
            self._answered.popleft()


class KeepingStream:
    """What durable streams have in common, however they wait."""

    def __init__(self, client: Any, session_id: str, reconnect_s: float, pause_s: float, pending_max: int):
        self._client = client
        self._session_id = session_id
        self._reconnect_s = reconnect_s
        self._pause_s = pause_s
        self._kept = Kept(session_id, pending_max)
        self._newest: Any = None
        self._stream: Any = None
        self._opened = client._known_states.opened_last(session_id)

    @property
    def pending(self) -> List[t.Measurement]:
        """Measurements that are not known to be durable, oldest first."""
        return self._kept.pending

    def _keep(self, measurement: t.Measurement) -> None:
        """Keeps one more. Raises what `Kept.put` raises."""
        self._kept.put(measurement)
        self._newest = self._client._known_states.report(measurement)

    def _look(self) -> None:
        """Looks whether this client has opened the session anew; what others open shows with the next answer."""
        opened = self._client._known_states.opened_last(self._session_id)
        if opened != self._opened:
            self._opened = opened
            self._kept.begins_anew()

    def _failed(self, error: NesamError) -> None:
        """Notes that a connection broke: where the vehicle was is known by the newest measurement all the same. Raises the error again where it is a refusal, or
        the client is closed."""
        if error.code not in BROKEN or self._client._is_closed:
            raise error
        if self._newest is not None:
            self._client._known_states.unheard(self._newest)

    def _until_again_s(self, error: NesamError) -> float:
        """Pause before the next connection: what the service asks for, else `pause_s`; never none at all."""
        return self._pause_s if error.retry_after_s is None else max(0.01, error.retry_after_s)
