"""Every unary call: which method of which service, with what, and what the reply means. The clients differ only in how they wait."""

import itertools
import re
import threading
import time
from dataclasses import dataclass, replace
from typing import Any, Callable, Dict, Generic, List, Optional, Sequence, Tuple, TypeVar, Union

import grpc
import numpy as np

from . import _messages as m
from . import _types as t
from ._candidates import Drawing, PathCost
from ._errors import DeadlineExceeded, FailedPrecondition, InvalidArgument, NesamError, NotFound, Overloaded, Unavailable
from ._extras import Extras
from ._fallback import KinematicFallback, Known, KnownState, invalid
from ._given import elevations, stamp, unmasked, whole
from ._refused import check_question
from .v1 import effects_pb2, prediction_pb2, sessions_pb2, soil_pb2, terrain_pb2, types_pb2

LATE = (DeadlineExceeded, Overloaded, Unavailable)
"""Errors of a service that is late, overloaded or away."""

KNOWN_AGE_MAX_S = 3.2
"""Oldest state that a fallback begins at, s by the client's clock: as far as it rolls one forward."""

_NO_ROOM = (grpc.StatusCode.RESOURCE_EXHAUSTED.value[0], grpc.StatusCode.UNAVAILABLE.value[0])
_NOT_FOUND = grpc.StatusCode.NOT_FOUND.value[0]


def is_late(error: NesamError) -> bool:
    """Whether a fallback may answer instead: the service is late, overloaded or away, or what it knows of the session is too old to be rolled forward."""
    return isinstance(error, LATE) or (isinstance(error, FailedPrecondition) and error.field == "start_stamp_ns")


def name_of(session: Union[str, t.Session]) -> str:
    """The id of a session, given as it is or as the session."""
    return session.session_id if isinstance(session, t.Session) else session


Told = TypeVar("Told")


@dataclass(frozen=True)
class Call(Generic[Told]):
    """A unary call: `service` and `method` by the name of the stub, the request or an iterator of requests, and how the reply is read."""

    service: str
    method: str
    request: Any
    read: Callable[[Any], Told]


def _nothing(_: Any) -> None:
    return None


def open_session(vehicle_id: str, session_id: str, map_id: str, vehicle_card: str, initial: Optional[t.Measurement]) -> Call[t.Session]:
    """Opens a session."""
    request = sessions_pb2.OpenSessionRequest(
        vehicle_id=vehicle_id,
        session_id=session_id,
        map_id=map_id,
        vehicle_card=vehicle_card,
        initial=None if initial is None else m.measurement_message(initial),
    )
    return Call("sessions", "Open", request, m.session)


def session(session_id: str) -> Call[t.Session]:
    """Reads a session."""
    return Call("sessions", "Get", sessions_pb2.GetSessionRequest(session_id=session_id), m.session)


def sessions() -> Call[List[t.Session]]:
    """Lists the sessions."""

    def read(reply: sessions_pb2.ListSessionsReply) -> List[t.Session]:
        return [m.session(s) for s in reply.sessions]

    return Call("sessions", "List", sessions_pb2.ListSessionsRequest(), read)


def fork_session(session_id: str, new_session_id: str) -> Call[t.Session]:
    """Copies a session."""
    request = sessions_pb2.ForkSessionRequest(session_id=session_id, new_session_id=new_session_id)
    return Call("sessions", "Fork", request, m.session)


def export_session(session_id: str) -> Call[bytes]:
    """Reads everything that a session remembers."""
    return Call("sessions", "Export", sessions_pb2.ExportSessionRequest(session_id=session_id), lambda reply: reply.image)


def import_session(image: bytes, session_id: str) -> Call[t.Session]:
    """Opens a session from an export."""
    return Call("sessions", "Import", sessions_pb2.ImportSessionRequest(image=image, session_id=session_id), m.session)


def close_session(session_id: str) -> Call[None]:
    """Closes a session."""
    return Call("sessions", "Close", sessions_pb2.CloseSessionRequest(session_id=session_id), _nothing)


def apply_effects(session_id: str, effects: Sequence[t.Effect], source: str) -> Call[t.Session]:
    """Puts effects on a session."""
    messages = [effects_pb2.Effect(id=e.id, parameters=m.parameter_messages(e)) for e in effects]
    request = effects_pb2.ApplyEffectsRequest(session_id=session_id, source=source, effects=messages)
    return Call("sessions", "ApplyEffects", request, m.session)


def revert_effects(session_id: str) -> Call[t.Session]:
    """Takes effects away."""
    return Call("sessions", "RevertEffects", effects_pb2.RevertEffectsRequest(session_id=session_id), m.session)


def upload_map(world: t.WorldMap) -> Call[t.MapDescription]:
    """Uploads a map in tiles."""
    elevation = elevations(world.elevation_m)
    if elevation.ndim != 2:
        raise ValueError(f"elevation_m has shape {elevation.shape}, expected (height, width)")
    return Call("terrain", "UploadMap", m.upload_messages(world, elevation), m.map_description)


def patch_tile(
    map_id: str, base_version: int, row: int, column: int, elevation_m: np.ndarray, semantic_rgb: Optional[np.ndarray]
) -> Call[t.MapDescription]:
    """Replaces a rectangle of a map."""
    tile = m.tile(row, column, elevations(elevation_m), semantic_rgb)
    request = terrain_pb2.PatchTileRequest(map_id=map_id, base_version=whole(base_version, "base_version", bits=64), tile=tile)
    return Call("terrain", "PatchTile", request, m.map_description)


def tile_too_large(error: InvalidArgument, elevation_m: np.ndarray) -> InvalidArgument:
    """What to say of a refused tile, (rows, columns): where it is larger than a message may be, as the transport says it, what the user can do."""
    limit = re.search(r"message length too large.*limit is: (\d+) bytes", error.message)
    if limit is None:
        return error
    rows, columns = np.shape(elevation_m)
    reason = (
        f"has {rows} x {columns} cells, more than fit into a message of {limit[1]} bytes (`grpc.tile_bytes_max` of the server; 4 bytes for a cell, 7 with colours); "
        "patch one part after the other, each at the version that the one before gave, or upload the whole map as a higher version, which planners see at once"
    )
    return invalid("elevation_m", reason)


def map_(map_id: str) -> Call[t.MapDescription]:
    """Describes a map."""
    return Call("terrain", "Get", terrain_pb2.GetMapRequest(map_id=map_id), m.map_description)


def maps() -> Call[List[t.MapDescription]]:
    """Lists the maps."""

    def read(reply: terrain_pb2.ListMapsReply) -> List[t.MapDescription]:
        return [m.map_description(one) for one in reply.maps]

    return Call("terrain", "List", terrain_pb2.ListMapsRequest(), read)


def fleet_soil(map_id: str) -> Call[t.FleetSoil]:
    """Reads the soil map of the fleet."""
    return Call("soil", "Map", soil_pb2.FleetSoilRequest(map_id=map_id), t.fleet_soil)


def delete_map(map_id: str) -> Call[None]:
    """Forgets a map."""
    return Call("terrain", "Delete", terrain_pb2.DeleteMapRequest(map_id=map_id), _nothing)


@dataclass(frozen=True)
class Question:
    """A prediction: the call, and what a fallback needs. The arguments are those of `Client.predict`; iterators are read once, as the call and the fallback both
    need what they give. ValueError for numbers and commands that do not fit."""

    session_id: str
    controls: Union[np.ndarray, Drawing]
    start: Optional[t.Vector] = None
    use_history: bool = True
    channels: Optional[Sequence[str]] = None
    stride: int = 1
    wheel_sinkage: bool = False
    fallback: Optional[KinematicFallback] = None
    start_stamp_ns: Optional[int] = None
    sent: Sequence[Tuple[int, Sequence[float]]] = ()
    half: bool = False
    extras: Optional[Extras] = None
    cost: Optional[PathCost] = None
    samples_min: int = 0

    def __post_init__(self) -> None:
        given: Dict[str, Any] = {
            "channels": None if self.channels is None else tuple(self.channels),
            "stride": whole(self.stride, "stride"),
            "start_stamp_ns": None if self.start_stamp_ns is None else stamp(self.start_stamp_ns, "start_stamp_ns"),
            "sent": tuple(_sent(i, pair) for i, pair in enumerate(self.sent)),
            "samples_min": whole(self.samples_min, "samples_min"),
        }
        if isinstance(self.controls, Drawing):
            whole(self.controls.samples, "samples")
        for name, value in given.items():
            object.__setattr__(self, name, value)

    def commands(self) -> np.ndarray:
        """(samples, horizon, 2) as they are sent, or (1, horizon, 2): the nominal sequence of a drawing. ValueError for another shape, or masked numbers."""
        drawing = self.controls if isinstance(self.controls, Drawing) else None
        given = unmasked(self.controls, "controls") if drawing is None else np.asarray(unmasked(drawing.nominal, "nominal"))[None]
        controls = np.ascontiguousarray(given, dtype="<f4")
        if controls.ndim != 3 or controls.shape[2] != 2:
            raise ValueError(f"controls have shape {controls.shape}, expected (samples, horizon, 2)")
        return controls

    def call(self) -> Call[t.Prediction]:
        """The call. ValueError for arrays of a wrong shape."""
        controls = self.commands()
        drawing = self.controls if isinstance(self.controls, Drawing) else None
        horizon = controls.shape[1]
        request = prediction_pb2.PredictRequest(
            session_id=self.session_id,
            start=None if self.start is None else t.state_message(self.start, "start"),
            history_use=prediction_pb2.HISTORY_USE_MEASURED if self.use_history else prediction_pb2.HISTORY_USE_NONE,
            samples=controls.shape[0] if drawing is None else drawing.samples,
            horizon=horizon,
            controls=controls.tobytes() if drawing is None else b"",
            drawing=None if drawing is None else drawing.message(),
            cost=None if self.cost is None else self.cost.message(),
            output=prediction_pb2.OutputSelection(
                channels=sum(1 << m.CHANNELS.index(name) for name in m.channel_names(self.channels)),
                stride=self.stride,
                wheel_sinkage=self.wheel_sinkage,
                precision=prediction_pb2.PRECISION_F16 if self.half else prediction_pb2.PRECISION_F32,
            ),
            start_stamp_ns=self.start_stamp_ns,
            sent=[
                prediction_pb2.SentCommand(stamp_ns=stamp_ns, command=types_pb2.Control(speed_m_s=command[0], second=command[1]))
                for stamp_ns, command in self.sent
            ],
            extras=None if self.extras is None else self.extras.message(),
            samples_min=self.samples_min,
        )
        # Who has a fallback does not wait for another attempt.
        service = "prediction" if self.fallback is None else "prediction_once"
        return Call(service, "Predict", request, lambda reply: m.prediction(reply, self.stride, horizon, self.extras))

    def fall_back(self, error: NesamError, known: Known) -> t.Prediction:
        """What the fallback answers from `start` or what is known, rolled forward to `start_stamp_ns`; raises the error again without one of them.

        Raises InvalidArgument where the service would refuse the question, too.
        """
        if self.fallback is None:
            raise error
        names, controls = m.channel_names(self.channels), self.commands()
        check_question(self, controls)
        sent = self.sent if self.start_stamp_ns is not None else ()
        self.fallback.check(controls, sent, "drawing.nominal" if isinstance(self.controls, Drawing) else "controls")
        if self.start is not None:
            begin: Optional[KnownState] = KnownState(t.array(self.start, (12,), "start"))
        else:
            begin = self.fallback.begins(known, self.start_stamp_ns, sent)
        if begin is None:
            raise error
        answered = m.fallback_prediction(self.fallback, begin, controls, names, self.stride, error)
        return replace(answered, controls=controls) if isinstance(self.controls, Drawing) else answered


def _sent(i: int, pair: Any) -> Tuple[int, Tuple[float, float]]:
    """The i-th command of `sent`."""
    try:
        stamp_ns, (speed, second) = pair
        command = float(speed), float(second)
    except (TypeError, ValueError):
        raise ValueError(f"sent[{i}] is {pair!r}, expected (stamp_ns, (speed, second))") from None
    return stamp(stamp_ns, f"sent[{i}].stamp_ns"), command


@dataclass(frozen=True)
class Moment:
    """When something was sent: its number among all that is, and the client's clock, s."""

    number: int
    at_s: float


@dataclass(frozen=True)
class Reported:
    """A measurement that was sent, as it was then; `known` is None where its state has a number that is not finite."""

    session_id: str
    known: Optional[KnownState]
    sent: Moment


@dataclass(frozen=True)
class _Newest:
    """A known state, None where the session was opened and nothing is known of it yet.

    asked: number of what it answered or of what was answered before. clock: of that with which the session or the vehicle's clock began anew. at_s: when it
    was so, by the client's clock. is_ahead: whether it is no step of the session yet, as far as the client knows: it waits for the grid, or got no answer.
    """

    known: Optional[KnownState]
    asked: int
    clock: int
    at_s: float
    is_ahead: bool = False

    def young(self) -> Optional[KnownState]:
        """The state where it is not too old to begin at."""
        return self.known if time.monotonic() - self.at_s <= KNOWN_AGE_MAX_S else None


class KnownStates:
    """The newest state that a client knows of each session; a fallback without a given start begins there. Where a prediction began that was rolled forward is
    kept apart: it is later than what was measured, and no measurement.

    What is sent is numbered, as answers may overtake each other: a state that was asked for later replaces another, one that was asked for earlier only where
    its stamp is larger and neither session nor vehicle's clock has begun anew since. A measurement that is no step of the session yet stays until a state with
    a larger stamp comes, or it is too old to begin at.
    """

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._states: Dict[str, _Newest] = {}
        self._ahead: Dict[str, _Newest] = {}
        self._opened: Dict[str, int] = {}
        self._lock = threading.Lock()

    def ask(self) -> Moment:
        """Number and time of what is sent now."""
        return Moment(next(self._numbers), time.monotonic())

    def report(self, measurement: t.Measurement) -> Reported:
        """A measurement that is sent now. ValueError for a state of a wrong shape."""
        # The vehicle may write its array anew.
        state = np.array(t.array(measurement.state, (12,), "state"))
        known = KnownState(state, measurement.stamp_ns) if np.isfinite(state).all() else None
        return Reported(measurement.session_id, known, self.ask())

    def measured(self, reported: Reported, answer: t.Answer) -> None:
        """Notes a measured state that is now the newest of its session."""
        begins_anew = answer.outcome in ("CLOCK_JUMP", "RESTARTED")
        if (begins_anew or answer.outcome in ("APPLIED", "BUFFERED", "GAP", "GATED")) and not answer.reordered:
            self._note(reported.session_id, reported.known, reported.sent, begins_anew, answer.outcome == "BUFFERED")
        elif answer.outcome == "REJECTED" and answer.code in _NO_ROOM:
            self.unheard(reported)
        elif answer.outcome == "REJECTED" and (answer.code, answer.field) == (_NOT_FOUND, "session_id"):
            self.forget(reported.session_id)

    def unheard(self, reported: Reported) -> None:
        """Notes a measured state that got no answer: the vehicle was there all the same."""
        newest = self._states.get(reported.session_id)
        # The same one sent again, or what was kept meanwhile, is not where the vehicle is now.
        if reported.known is not None and (newest is None or _is_later(reported.known, newest.known)):
            self._note(reported.session_id, reported.known, reported.sent, is_ahead=True)

    def predicted(self, asked: Moment, question: Question, prediction: t.Prediction) -> t.Prediction:
        """Notes where a prediction of the session began that was not given its start, and gives it back."""
        if question.start is None:
            # Who asks from an instant asks from now.
            age_s = 0.0 if question.start_stamp_ns is not None else prediction.measurement_age_s or 0.0
            known = KnownState(np.array(prediction.start, dtype=np.float64), prediction.start_stamp_ns, prediction.rolled_forward_steps)
            begun = replace(asked, at_s=asked.at_s - age_s)
            if known.rolled_forward_steps > 0:
                self._note_ahead(question.session_id, known, begun)
            else:
                # Measurements may have overtaken the instant that was asked from.
                self._note(question.session_id, known, begun, is_overtaken=question.start_stamp_ns is not None)
        return prediction

    def fall_back(self, question: Question, error: NesamError) -> t.Prediction:
        """What the fallback of a question answers; raises the error again where it is no lateness, without a fallback or without a state that is new enough."""
        if isinstance(error, NotFound) and error.field == "session_id":
            self.forget(question.session_id)
        if not is_late(error):
            raise error
        measured, ahead = (states.get(question.session_id) for states in (self._states, self._ahead))
        known = Known(None if measured is None else measured.young(), None if ahead is None else ahead.young())
        return question.fall_back(error, known)

    def opened(self, session: t.Session) -> t.Session:
        """Forgets what was known under the name of a session that was opened now, also what comes late, and gives it back."""
        now = self.ask()
        with self._lock:
            self._opened[session.session_id] = now.number
            self._states[session.session_id] = _Newest(None, now.number, now.number, now.at_s)
            self._ahead.pop(session.session_id, None)
        return session

    def opened_last(self, session_id: str) -> int:
        """Number of when this client opened a session of that name last; 0 = never."""
        return self._opened.get(session_id, 0)

    def forget(self, session_id: str) -> None:
        """Forgets a closed session."""
        with self._lock:
            self._states.pop(session_id, None)
            self._ahead.pop(session_id, None)

    def _note(
        self, session_id: str, known: Optional[KnownState], sent: Moment, begins_anew: bool = False, is_ahead: bool = False, is_overtaken: bool = False
    ) -> None:
        if known is None:
            return
        with self._lock:
            newest = self._states.get(session_id)
            if newest is None:
                self._states[session_id] = _Newest(known, sent.number, sent.number if begins_anew else 0, sent.at_s, is_ahead)
            elif sent.number > newest.clock and (begins_anew or _replaces(known, sent, newest, newest.is_ahead or is_overtaken)):
                clock = sent.number if begins_anew else newest.clock
                self._states[session_id] = _Newest(known, max(sent.number, newest.asked), clock, sent.at_s, is_ahead)
            ahead = self._ahead.get(session_id)
            if begins_anew and ahead is not None and ahead.asked < sent.number:
                del self._ahead[session_id]

    def _note_ahead(self, session_id: str, known: KnownState, asked: Moment) -> None:
        """Notes a state that the service rolled forward, unless a later question has told of another one or the clock has begun anew since."""
        with self._lock:
            measured, ahead = self._states.get(session_id), self._ahead.get(session_id)
            clock = 0 if measured is None else measured.clock
            if asked.number > max(clock, 0 if ahead is None else ahead.asked):
                self._ahead[session_id] = _Newest(known, asked.number, clock, asked.at_s)


def _replaces(known: KnownState, sent: Moment, newest: _Newest, stays: bool) -> bool:
    """Whether a state of the same clock is newer than the newest one, which stays before one that is not later."""
    if stays and sent.at_s - newest.at_s <= KNOWN_AGE_MAX_S:
        return _is_later(known, newest.known)
    return sent.number > newest.asked or _is_later(known, newest.known)


def _is_later(known: KnownState, other: Optional[KnownState]) -> bool:
    return other is None or (known.stamp_ns is not None and other.stamp_ns is not None and known.stamp_ns > other.stamp_ns)
