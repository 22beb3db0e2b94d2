"""The synchronous client."""

import queue
import threading
from typing import Any, Callable, Iterable, Iterator, List, Optional, Sequence, Tuple, Union

import grpc
import numpy as np

from . import _calls as calls
from . import _diagnosis as diagnosis
from . import _messages as m
from . import _types as t
from ._candidates import Drawing, PathCost
from ._connection import ATTEMPTS_MAX, Connected, Options, arguments, finite_timeout, trying_again
from ._durable import DurableStream
from ._errors import InvalidArgument, NesamError
from ._extras import Extras
from ._fallback import KinematicFallback
from ._given import vehicle_or_none
from ._routing import VehicleHeader
from ._stream import ON_THE_WAY_MAX, OpenStream
from .v1 import (
    alarms_pb2,
    diagnosis_pb2_grpc,
    measurements_pb2_grpc,
    prediction_pb2_grpc,
    sessions_pb2_grpc,
    soil_pb2,
    soil_pb2_grpc,
    terrain_pb2_grpc,
)


class Client(Connected):
    """A connection to a service, e.g. `Client("127.0.0.1:50051")`. Threads may share it. Close it, or use it in a `with` block.

    address: host:port. timeout_s: longest wait of a call that gives no other, s; infinite = no limit. tls: what the client trusts and shows; None = no TLS.
    vehicle_id: told with every call, for a proxy in front of several servers (deploy/haproxy); "" = not told.
    attempts_max: how often a call is tried that only reads (`session`, `sessions`, `export_session`, `map`, `maps`, `fleet_soil`, `predict`) and is UNAVAILABLE, 1 to 5;
    1 = once. The pauses between them grow from 0.1 s to 1 s, together about 2 s; all is over by the deadline of the call. A prediction with a fallback is tried
    once, and so is all that changes something. ValueError for another number, a vehicle_id that is no name, or an address that begins with http or has no port.

    What is asked of a client that is closed, or was on its way when it was, is Unavailable.

    A client is one connection, of which the server takes 256 requests at once by default (`grpc.streams_per_connection_max`). Each `alarms`, `watch_soil`, `diagnose`
    and open stream is one of them as long as it lasts; beyond that predictions wait and end with DeadlineExceeded. Who watches so many sessions does so with another
    client. There is no `PredictStream`: calls of `predict` share the connection, and each has its own deadline and fallback.
    """

    def __init__(
        self, address: str, timeout_s: float = 10.0, tls: Optional[t.Tls] = None, vehicle_id: str = "", attempts_max: int = ATTEMPTS_MAX
    ):
        self.timeout_s = timeout_s
        options, credentials = arguments(address, tls)
        vehicle_id = vehicle_or_none(vehicle_id)

        def opened(options: Options) -> Any:
            channel = grpc.insecure_channel(address, options) if credentials is None else grpc.secure_channel(address, credentials, options)
            return grpc.intercept_channel(channel, VehicleHeader(vehicle_id)) if vehicle_id else channel

        self._channel = opened(options + trying_again(attempts_max))
        # gRPC gives both the same connection; over TLS the first prediction with a fallback makes another one.
        self._once = opened(options)
        self._stubs = {
            "sessions": sessions_pb2_grpc.SessionsStub(self._channel),
            "prediction": prediction_pb2_grpc.PredictionStub(self._channel),
            "prediction_once": prediction_pb2_grpc.PredictionStub(self._once),
            "terrain": terrain_pb2_grpc.TerrainStub(self._channel),
            "soil": soil_pb2_grpc.SoilStub(self._channel),
            "diagnosis": diagnosis_pb2_grpc.DiagnosisStub(self._channel),
        }
        self._open_measurements = measurements_pb2_grpc.MeasurementsStub(self._channel).Stream
        self._known_states = calls.KnownStates()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. What is on its way is Unavailable."""
        self._is_closed = True
        self._channel.close()
        self._once.close()

    def _do(self, call: calls.Call[calls.Told], timeout_s: Optional[float] = None) -> calls.Told:
        method = getattr(self._stubs[call.service], call.method)
        try:
            return call.read(method(call.request, timeout=finite_timeout(self.timeout_s if timeout_s is None else timeout_s)))
        except (grpc.RpcError, ValueError) as error:
            raise self._refusal(error) from None

    def _watch(self, service: str, method: str, request: Any, read: Callable[[Any], calls.Told], timeout_s: Optional[float]) -> Iterator[calls.Told]:
        call = None
        try:
            call = getattr(self._stubs[service], method)(request, timeout=finite_timeout(timeout_s))
            for message in call:
                yield read(message)
        except (grpc.RpcError, ValueError) as error:
            raise self._refusal(error) from None
        finally:
            # Whoever stops listening ends the call, and what the service does for it.
            if call is not None:
                call.cancel()

    # Sessions

    def open_session(
        self,
        vehicle_id: str,
        session_id: str = "",
        map_id: str = "",
        vehicle_card: str = "",
        initial: Optional[t.Measurement] = None,
    ) -> t.Session:
        """Opens a session. An empty session id means the vehicle id, an empty map id no map.

        Raises InvalidArgument (bad name, other vehicle card, bad initial measurement), NotFound (map), AlreadyExists, Overloaded.
        """
        return self._known_states.opened(self._do(calls.open_session(vehicle_id, session_id, map_id, vehicle_card, initial)))

    def session(self, session_id: str) -> t.Session:
        """Reads a session. Raises NotFound."""
        return self._do(calls.session(session_id))

    def sessions(self) -> List[t.Session]:
        """All open sessions, by id."""
        return self._do(calls.sessions())

    def fork_session(self, session_id: str, new_session_id: str) -> t.Session:
        """Copies a session with its history and soil under another name. Raises NotFound, InvalidArgument, AlreadyExists, Overloaded."""
        return self._known_states.opened(self._do(calls.fork_session(session_id, new_session_id)))

    def export_session(self, session_id: str) -> bytes:
        """Everything that a session remembers, for `import_session` here or on another server with the same bundle. Raises NotFound."""
        return self._do(calls.export_session(session_id))

    def import_session(self, image: bytes, session_id: str = "") -> t.Session:
        """Opens a session from an export; it answers as the original would, bit for bit. An empty name keeps that of the exported one.

        Raises InvalidArgument (damaged, another version, another bundle), NotFound (map), FailedPrecondition (the map has other layers), AlreadyExists,
        PermissionDenied as NesamError (another's vehicle, or an image with effects without the rights of an operator).
        """
        return self._known_states.opened(self._do(calls.import_session(image, session_id)))

    def close_session(self, session_id: str) -> None:
        """Closes a session and forgets its history. Raises NotFound."""
        self._do(calls.close_session(session_id))
        self._known_states.forget(session_id)

    # Effects and alarms

    def apply_effects(self, session_id: str, effects: Sequence[t.Effect], source: str = "") -> t.Session:
        """Puts physical effects on a session, in place of those that were applied before; its soil begins again from the prior. Needs the rights of an operator.

        Raises NotFound, InvalidArgument (none or too many, an unknown id or parameter, a value outside its range), PermissionDenied as NesamError.
        """
        return self._do(calls.apply_effects(session_id, effects, source))

    def revert_effects(self, session_id: str) -> t.Session:
        """Takes the applied effects away again; its soil begins again from the prior. Needs the rights of an operator.

        Raises NotFound, PermissionDenied as NesamError.
        """
        return self._do(calls.revert_effects(session_id))

    def alarms(self, session_id: str, timeout_s: Optional[float] = None) -> Iterator[t.Alarm]:
        """The alarms of a session as they come: the active one first, then each that is raised or cleared. Ends when the session closes.

        timeout_s: longest time to listen from the first that is asked for, s; None = until the session closes.

        Raises NotFound, DeadlineExceeded (after `timeout_s`), Unavailable (ask anew).
        """
        request = alarms_pb2.WatchAlarmsRequest(session_id=session_id)
        return self._watch("sessions", "WatchAlarms", request, m.alarm, timeout_s)

    def diagnose(
        self,
        session_id: str,
        recording: str = "",
        from_stamp_ns: Optional[int] = None,
        to_stamp_ns: Optional[int] = None,
        seed: Optional[int] = None,
        reference: str = "bundle",
        controls: bool = True,
        timeout_s: Optional[float] = None,
    ) -> Iterator[t.DiagnosisEvent]:
        """Diagnoses what the service recorded of a session: which effect does the model lack? Tells the start, progress, and last the report; it takes minutes.

        It begins when the first event is asked for; leaving the iterator ends it. recording: name of an earlier run of the server, "" = what it has recorded until
        now. Stamps bound the window by the vehicle's clock, None = all. reference: "bundle" or "physics". controls: whether to try what would expose a wrong claim,
        too. timeout_s: longest time for all of it, s; None = that of the service. Needs the rights of an operator.

        Raises FailedPrecondition (nothing is recorded, or what was cannot be diagnosed), NotFound (recording), InvalidArgument, Overloaded (others run),
        DeadlineExceeded (`timeout_s`, or `diagnosis.limit_s` of the service), PermissionDenied as NesamError; ValueError for an unknown reference.
        """
        request = diagnosis.request(session_id, recording, from_stamp_ns, to_stamp_ns, seed, reference, controls)
        return self._watch("diagnosis", "Start", request, diagnosis.event, timeout_s)

    # Soil

    def watch_soil(self, session_id: str, timeout_s: Optional[float] = None) -> Iterator[t.SoilEstimate]:
        """What a session knows of the soil: the present estimate at once, then each change. Ends when the session closes.

        timeout_s: longest time to listen from the first that is asked for, s; None = until the session closes.

        Raises NotFound, DeadlineExceeded (after `timeout_s`), Unavailable (ask anew).
        """
        request = soil_pb2.WatchSoilRequest(session_id=session_id)
        return self._watch("soil", "Watch", request, t.soil_estimate, timeout_s)

    def fleet_soil(self, map_id: str = "") -> t.FleetSoil:
        """What the fleet has learned of the ground of a map, "" = of all. Raises FailedPrecondition (the service keeps no such map: `fleet_soil.enabled`)."""
        return self._do(calls.fleet_soil(map_id))

    # Maps

    def upload_map(self, world: t.WorldMap, timeout_s: float = 120.0) -> t.MapDescription:
        """Uploads a map in tiles.

        What is masked in the elevations is a hole. Raises InvalidArgument, AlreadyExists (this or a newer version is there), Overloaded (too many maps or cells);
        ValueError for arrays of a wrong shape, colours that are not uint8 or are masked.
        """
        return self._do(calls.upload_map(world), timeout_s)

    def patch_tile(
        self,
        map_id: str,
        base_version: int,
        row: int,
        column: int,
        elevation_m: np.ndarray,
        semantic_rgb: Optional[np.ndarray] = None,
    ) -> t.MapDescription:
        """Replaces the rectangle whose south-west cell is (row, column); without colours the old ones stay. The result is the next version.

        elevation_m: (rows, columns), m in World, NaN or masked = hole. semantic_rgb: (rows, columns, 3) uint8.

        Raises NotFound, InvalidArgument (it lies outside the map, or is larger than a message may be, `grpc.tile_bytes_max` of the server: 1 M cells by default,
        600 000 with colours), NesamError with code ABORTED when the map is not at `base_version` any more; ValueError for arrays of a wrong shape and a negative
        row, column or version. One call is one version, all of it at once: what is too large is for you to cut, each part at the version that the one before gave,
        or for `upload_map` under a higher version.
        """
        try:
            return self._do(calls.patch_tile(map_id, base_version, row, column, elevation_m, semantic_rgb))
        except InvalidArgument as error:
            raise calls.tile_too_large(error, elevation_m) from None

    def map(self, map_id: str) -> t.MapDescription:
        """Describes a map. Raises NotFound."""
        return self._do(calls.map_(map_id))

    def maps(self) -> List[t.MapDescription]:
        """All maps, by id."""
        return self._do(calls.maps())

    def delete_map(self, map_id: str) -> None:
        """Forgets a map. Raises NotFound, FailedPrecondition (a session uses it)."""
        self._do(calls.delete_map(map_id))

    # Measurements

    def measure(self, measurements: Iterable[t.Measurement]) -> List[t.Answer]:
        """Sends measurements without waiting for answers in between, and returns the answer to each, in order, after the last: for recorded drives. It keeps all
        answers until then, and they are lost where the connection breaks; a vehicle that goes on and on uses `exchange`. What the service refuses is answered
        (REJECTED), not raised.

        Raises DeadlineExceeded when an answer takes longer than the client's `timeout_s`, Unavailable; ValueError for an array of a wrong shape.
        """
        with self.measurement_stream() as stream:
            return list(stream._answers(measurements, self.timeout_s))

    def exchange(self, measurements: Iterable[t.Measurement]) -> Iterator[t.Answer]:
        """Sends each measurement when the iterable gives it, without waiting for answers, and gives the answer to each as it comes, in order: for a vehicle that
        reports at its own pace. What the service refuses is answered (REJECTED), not raised.

        A thread of its own takes the measurements from the iterable, from when the first answer is asked for. At most 256 are on their way: beyond that it waits
        until an answer is taken. It ends with the iterable; where the loop over the answers is left before, with the next measurement that the iterable gives,
        which is not sent.

        Raises, after all answers that came, DeadlineExceeded when one takes longer than the client's `timeout_s`, Unavailable, and what the iterable raises;
        ValueError for an array of a wrong shape. The measurements that got no answer are for you to send again, or for a `durable_stream`.
        """
        with self.measurement_stream() as stream:
            yield from stream._exchange(measurements, self.timeout_s)

    def measurement_stream(self) -> "MeasurementStream":
        """An open stream that waits for the answer to each measurement; use it in a `with` block."""
        return MeasurementStream(self)

    def durable_stream(self, session_id: str, reconnect_s: float = 30.0, pause_s: float = 0.2, pending_max: int = 65536) -> DurableStream:
        """A stream that keeps measurements until the service has them on stable storage, and sends them again after a crash of the server.

        reconnect_s: longest time without the service before `send` gives up and raises Unavailable, s; the measurement is kept all the same. `send` waits for so long, and
        meanwhile this client hears of no newer state: after 3.2 s a fallback has none to begin at. Where a planner lives on a fallback give less time than lies between
        two measurements, such as 0.05 s, and more than an answer takes. pause_s: time between two attempts where the service asks for none, s. pending_max: measurements that are kept at
        most; beyond it `send` raises Overloaded. A store commits at least every second (`store.interval_s`), so the default is more than ten minutes at 100 Hz.
        The server needs a store (`nesam serve --store DIR`): without one nothing becomes durable, and `pending_max` measurements are all that can be sent.
        """
        return DurableStream(self, session_id, reconnect_s, pause_s, pending_max)

    # Predictions

    def predict(
        self,
        session_id: Union[str, t.Session],
        controls: Union[np.ndarray, Drawing],
        start: Optional[t.Vector] = None,
        use_history: bool = True,
        channels: Optional[Sequence[str]] = None,
        stride: int = 1,
        wheel_sinkage: bool = False,
        timeout_s: Optional[float] = None,
        fallback: Optional[KinematicFallback] = None,
        start_stamp_ns: Optional[int] = None,
        sent: Sequence[Tuple[int, Sequence[float]]] = (),
        half: bool = False,
        extras: Optional[Extras] = None,
        cost: Optional[PathCost] = None,
        samples_min: int = 0,
    ) -> t.Prediction:
        """Rolls candidate command sequences out from the newest state of a session, given by its id or as it is, or from `start`.

        controls: (samples, horizon, 2): speed m/s, second command in the unit of the vehicle card; one step is 0.1 s; or a `Drawing`, by which the
        service draws them: `Prediction.controls` then tells what they were. cost: lets the service rank the candidates along a path and send the best
        only; `Prediction.ranking` has the costs of all; not together with extras. samples_min: fewest samples that are of use when the deadline is near, 0 =
        all or nothing; the arrays then have as many rows as were computed. start: (12,), pose in World, twist in Body; with `use_history` it is taken to hold
        at the instant of the newest measurement. channels: names from CHANNELS to return, default all; they come in the order of CHANNELS, whatever that of the names, and Prediction.channels says which. stride: returns the steps stride, 2 stride, ...
        timeout_s: deadline, default that of the client, infinite = none. fallback: answers instead when the service is late, overloaded or away, or knows no
        measurement that is new enough for `start_stamp_ns`, from `start` or the newest state that this client knows and that is not older than 3.2 s; the
        prediction says so. It does so at once, without another attempt, and refuses what the service would: numbers that are not finite, commands outside the
        range of its card, shapes, costs and starts beyond the limits (number of samples and extras apart). start_stamp_ns: asks from this instant of the
        vehicle's clock on: the service rolls the session forward to it, rounded to the nearest step of 0.1 s after the newest measurement, so by up to 50 ms
        (`Prediction.start_stamp_ns` says from when), with the commands `sent`, pairs (stamp_ns, (speed, second)) by ascending stamp; not together with `start`.
        half: lets the reply travel as 16-bit numbers; positions are rounded by at most 4 mm within 16 m of the start. extras: Jacobians, covariance, risk and
        what-if soils; the answer is in `Prediction.extras`. A fallback rolls a known state forward by its own kinematics, no further than 32 steps, predicts the
        nominal sequence of a drawing alone, and has no extras and no `ranking` (None).

        Raises InvalidArgument, NotFound, FailedPrecondition (no state to start from, none that is new enough for `start_stamp_ns`, or it lies off the map),
        Overloaded, DeadlineExceeded, Unavailable; ValueError for arrays of a wrong shape or with masked numbers, numbers that do not fit (a negative `stride`,
        `samples_min`, `seed` or `best`), and a command in `sent` that is no pair.
        """
        question = calls.Question(
            calls.name_of(session_id),
            controls,
            start=start,
            use_history=use_history,
            channels=channels,
            stride=stride,
            wheel_sinkage=wheel_sinkage,
            fallback=fallback,
            start_stamp_ns=start_stamp_ns,
            sent=sent,
            half=half,
            extras=extras,
            cost=cost,
            samples_min=samples_min,
        )
        asked = self._known_states.ask()
        try:
            return self._known_states.predicted(asked, question, self._do(question.call(), timeout_s))
        except NesamError as error:
            return self._known_states.fall_back(question, error)


_SENT = object()


class MeasurementStream(OpenStream):
    """One open stream: `send` returns the answer. Threads must not share it."""

    def __init__(self, client: Client):
        self._heard: "queue.SimpleQueue[Any]" = queue.SimpleQueue()
        super().__init__(client, self._heard.put)

    def __enter__(self) -> "MeasurementStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, measurement: t.Measurement, timeout_s: Optional[float] = None) -> t.Answer:
        """Sends one measurement and waits for its answer, at most for `timeout_s`, default that of the client: a busy service holds up whoever sends so.
        `Client.exchange` sends the next measurements meanwhile.

        Raises DeadlineExceeded when none comes in time, which ends the stream; what the service ended the stream with, also when asked again; Unavailable after
        `close`; ValueError for an array of a wrong shape.
        """
        self._put(measurement)
        return self._next(self._client.timeout_s if timeout_s is None else timeout_s)

    def close(self) -> None:
        """Says that no more measurements come."""
        self._say_end()

    def _exchange(self, measurements: Iterable[t.Measurement], timeout_s: float) -> Iterator[t.Answer]:
        """The answers to measurements that another thread sends without waiting for them, each within `timeout_s` of the one before or of its own sending."""
        # Of each that was sent, and of the end what the iterable raised, None where nothing.
        sent: "queue.SimpleQueue[Any]" = queue.SimpleQueue()
        room = threading.Semaphore(ON_THE_WAY_MAX)

        def send_all() -> None:
            ended: Optional[BaseException] = None
            try:
                for measurement in measurements:
                    room.acquire()
                    self._put(measurement)
                    sent.put(_SENT)
            except BaseException as error:
                ended = error
            sent.put(ended)

        threading.Thread(target=send_all, daemon=True).start()
        try:
            while (told := sent.get()) is _SENT:
                yield self._next(timeout_s)
                room.release()
            if told is not None:
                raise told
        finally:
            # It sends no more then.
            self.close()
            room.release()

    def _answers(self, measurements: Iterable[t.Measurement], timeout_s: float) -> Iterator[t.Answer]:
        """The answers to measurements that are sent without waiting for them, by this thread."""
        for measurement in measurements:
            self._put(measurement)
            while self._waiting and (not self._heard.empty() or self._left_s(timeout_s) == 0.0):
                yield self._next(timeout_s)
        while self._waiting:
            yield self._next(timeout_s)

    def _next(self, timeout_s: float) -> t.Answer:
        """The answer to the oldest measurement that waits for one."""
        try:
            heard = self._heard.get(timeout=self._left_s(timeout_s))
        except queue.Empty:
            raise self._late(timeout_s) from None
        except BaseException:
            self._cancel()
            raise
        return self._answer(heard)
