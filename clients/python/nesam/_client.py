"""The synchronous client."""

import queue
import threading
from typing import Dict, Iterable, Iterator, List, Optional, Sequence, Tuple, Union

import grpc
import numpy as np

from . import _types as t
from ._durable import DurableStream
from ._errors import DeadlineExceeded, NesamError, Overloaded, Unavailable, from_rpc
from ._candidates import Drawing, PathCost, ranking
from ._extras import Extras, extra_outputs
from ._fallback import KinematicFallback
from ._routing import VehicleHeader
from .v1 import (
    alarms_pb2,
    effects_pb2,
    measurements_pb2,
    measurements_pb2_grpc,
    prediction_pb2,
    prediction_pb2_grpc,
    sessions_pb2,
    sessions_pb2_grpc,
    terrain_pb2,
    terrain_pb2_grpc,
    types_pb2,
)

CHANNELS: Tuple[str, ...] = ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "wx", "wy", "wz")
"""Names of the channels of a state, in order."""

_SECOND_KINDS = {1: "steering_normalised", 2: "road_wheel_angle_rad", 3: "yaw_rate_rad_s"}
_REPLY_BYTES_MAX = 16 << 20
_TILE_CELLS = 256 << 10


class Client:
    """A connection to a service, e.g. `Client("127.0.0.1:50051")`. Threads may share it. Close it, or use it in a `with` block.

    timeout_s: longest wait of a call that gives no other, s. tls: what the client trusts and shows; None = no TLS.
    vehicle_id: told with every call, for a proxy in front of several servers (deploy/haproxy); "" = not told.
    """

    def __init__(self, address: str, timeout_s: float = 10.0, tls: Optional[t.Tls] = None, vehicle_id: str = ""):
        self.timeout_s = timeout_s
        options = [("grpc.max_receive_message_length", _REPLY_BYTES_MAX)]
        if tls is None:
            self._channel = grpc.insecure_channel(address, options=options)
        else:
            if tls.server_name:
                options.append(("grpc.ssl_target_name_override", tls.server_name))
            credentials = grpc.ssl_channel_credentials(tls.authority, tls.key, tls.certificate)
            self._channel = grpc.secure_channel(address, credentials, options=options)
        if vehicle_id:
            self._channel = grpc.intercept_channel(self._channel, VehicleHeader(vehicle_id))
        self._sessions = sessions_pb2_grpc.SessionsStub(self._channel)
        self._prediction = prediction_pb2_grpc.PredictionStub(self._channel)
        self._measurements = measurements_pb2_grpc.MeasurementsStub(self._channel)
        self._terrain = terrain_pb2_grpc.TerrainStub(self._channel)
        # Newest state that this client knows of each session; a fallback without a given start begins there.
        self._known_states: Dict[str, np.ndarray] = {}

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection."""
        self._channel.close()

    def _call(self, method, request, timeout_s: Optional[float] = None):
        try:
            return method(request, timeout=self.timeout_s if timeout_s is None else timeout_s)
        except grpc.RpcError as error:
            raise from_rpc(error) from None

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
        request = sessions_pb2.OpenSessionRequest(
            vehicle_id=vehicle_id,
            session_id=session_id,
            map_id=map_id,
            vehicle_card=vehicle_card,
            initial=None if initial is None else _measurement_message(initial),
        )
        return _session(self._call(self._sessions.Open, request))

    def session(self, session_id: str) -> t.Session:
        """Reads a session. Raises NotFound."""
        return _session(self._call(self._sessions.Get, sessions_pb2.GetSessionRequest(session_id=session_id)))

    def sessions(self) -> List[t.Session]:
        """All open sessions, by id."""
        return [_session(s) for s in self._call(self._sessions.List, sessions_pb2.ListSessionsRequest()).sessions]

    def fork_session(self, session_id: str, new_session_id: str) -> t.Session:
        """Copies a session with its history and soil under another name. Raises NotFound, InvalidArgument, AlreadyExists, Overloaded."""
        request = sessions_pb2.ForkSessionRequest(session_id=session_id, new_session_id=new_session_id)
        return _session(self._call(self._sessions.Fork, request))

    def export_session(self, session_id: str) -> bytes:
        """Everything that a session remembers, for `import_session` here or on another server with the same bundle. Raises NotFound."""
        return self._call(self._sessions.Export, sessions_pb2.ExportSessionRequest(session_id=session_id)).image

    def import_session(self, image: bytes, session_id: str = "") -> t.Session:
        """Opens a session from an export; it answers as the original would, bit for bit. An empty name keeps that of the exported one.

        Raises InvalidArgument (damaged, another version, another bundle), NotFound (map), FailedPrecondition (the map has other layers), AlreadyExists.
        """
        return _session(self._call(self._sessions.Import, sessions_pb2.ImportSessionRequest(image=image, session_id=session_id)))

    def close_session(self, session_id: str) -> None:
        """Closes a session and forgets its history. Raises NotFound."""
        self._call(self._sessions.Close, sessions_pb2.CloseSessionRequest(session_id=session_id))
        self._known_states.pop(session_id, None)

    # Effects and alarms

    def apply_effects(self, session_id: str, effects: Sequence[t.Effect], source: str = "") -> t.Session:
        """Puts physical effects on a session, in place of those that were applied before; its soil begins again from the prior. Needs the rights of an operator.

        Raises NotFound, InvalidArgument (none or too many, an unknown id or parameter, a value outside its range), PermissionDenied as NesamError.
        """
        messages = [effects_pb2.Effect(id=e.id, parameters=_parameter_messages(e)) for e in effects]
        request = effects_pb2.ApplyEffectsRequest(session_id=session_id, source=source, effects=messages)
        return _session(self._call(self._sessions.ApplyEffects, request))

    def revert_effects(self, session_id: str) -> t.Session:
        """Takes the applied effects away again. Raises NotFound."""
        return _session(self._call(self._sessions.RevertEffects, effects_pb2.RevertEffectsRequest(session_id=session_id)))

    def alarms(self, session_id: str) -> Iterator[t.Alarm]:
        """The alarms of a session as they come: the active one first, then each that is raised or cleared. Ends when the session closes. Raises NotFound."""
        try:
            for message in self._sessions.WatchAlarms(alarms_pb2.WatchAlarmsRequest(session_id=session_id)):
                yield _alarm(message)
        except grpc.RpcError as error:
            raise from_rpc(error) from None

    # Maps

    def upload_map(self, world: t.WorldMap, timeout_s: float = 120.0) -> t.MapDescription:
        """Uploads a map in tiles. Raises InvalidArgument, AlreadyExists (this or a newer version is there), Overloaded (too many maps or cells)."""
        elevation = np.ascontiguousarray(world.elevation_m, dtype="<f4")
        if elevation.ndim != 2:
            raise ValueError(f"elevation_m has shape {elevation.shape}, expected (height, width)")
        return _map_description(self._call(self._terrain.UploadMap, _upload_messages(world, elevation), timeout_s))

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

        Raises NotFound, InvalidArgument, NesamError with code ABORTED when the map is not at `base_version` any more.
        """
        elevation = np.ascontiguousarray(elevation_m, dtype="<f4")
        tile = _tile(row, column, elevation, semantic_rgb)
        request = terrain_pb2.PatchTileRequest(map_id=map_id, base_version=base_version, tile=tile)
        return _map_description(self._call(self._terrain.PatchTile, request))

    def map(self, map_id: str) -> t.MapDescription:
        """Describes a map. Raises NotFound."""
        return _map_description(self._call(self._terrain.Get, terrain_pb2.GetMapRequest(map_id=map_id)))

    def maps(self) -> List[t.MapDescription]:
        """All maps, by id."""
        return [_map_description(m) for m in self._call(self._terrain.List, terrain_pb2.ListMapsRequest()).maps]

    def delete_map(self, map_id: str) -> None:
        """Forgets a map. Raises NotFound, FailedPrecondition (a session uses it)."""
        self._call(self._terrain.Delete, terrain_pb2.DeleteMapRequest(map_id=map_id))

    # Measurements

    def measure(self, measurements: Iterable[t.Measurement]) -> List[t.Answer]:
        """Sends measurements and returns the answer to each, in order. A bad measurement is answered, not raised."""
        sent: List[t.Measurement] = []

        def messages() -> Iterator[measurements_pb2.Measurement]:
            for measurement in measurements:
                sent.append(measurement)
                yield _measurement_message(measurement)

        answers = []
        try:
            for message in self._measurements.Stream(messages()):
                answers.append(_answer(message))
                self._remember(sent[len(answers) - 1], answers[-1])
        except grpc.RpcError as error:
            raise from_rpc(error) from None
        return answers

    def measurement_stream(self) -> "MeasurementStream":
        """An open stream for a vehicle that reports at its own pace; use it in a `with` block."""
        return MeasurementStream(self)

    def durable_stream(self, session_id: str, reconnect_s: float = 30.0, pause_s: float = 0.2) -> DurableStream:
        """A stream that keeps measurements until the service has them on stable storage, and sends them again after a crash of the server.

        reconnect_s: longest time without the service before `send` gives up, s. pause_s: time between two attempts, s. The server needs a store
        (`nesam serve --store DIR`).
        """
        return DurableStream(self, session_id, reconnect_s, pause_s)

    def _remember(self, measurement: t.Measurement, answer: t.Answer) -> None:
        if answer.outcome in ("APPLIED", "GAP", "GATED", "CLOCK_JUMP", "RESTARTED") and not answer.reordered:
            self._known_states[measurement.session_id] = np.asarray(measurement.state, dtype=np.float64)

    # Predictions

    def predict(
        self,
        session_id: str,
        controls: Union[np.ndarray, Drawing],
        start: Optional[Sequence[float]] = None,
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
    ) -> t.Prediction:
        """Rolls candidate command sequences out from the session's newest state, or from `start`.

        controls: (samples, horizon, 2): speed m/s, second command in the unit of the vehicle card; one step is 0.1 s; or a `Drawing`, by which the
        service draws them: `Prediction.controls` then tells what they were. cost: lets the service rank the candidates along a path and send the best
        only; `Prediction.ranking` has the costs of all. start: (12,); with
        `use_history` it is taken to hold at the instant of the newest measurement. channels: names from CHANNELS to return, default all.
        stride: returns the steps stride, 2 stride, ... timeout_s: deadline, default that of the client. fallback: answers instead when the
        service is late, overloaded or away, from `start` or the newest state that this client knows; the prediction says so.
        start_stamp_ns: asks from this instant of the vehicle's clock on: the service rolls the session forward to it with the commands `sent`,
        pairs (stamp_ns, (speed, second)) by ascending stamp. half: lets the reply travel as 16-bit numbers; positions are rounded by at most
        4 mm within 16 m of the start. A fallback does not roll forward and predicts the nominal sequence of a drawing alone. extras: Jacobians, covariance, risk and what-if soils; the answer is in
        `Prediction.extras`, a fallback has none.

        Raises InvalidArgument, NotFound, FailedPrecondition (no state to start from, or it lies off the map), Overloaded, DeadlineExceeded,
        Unavailable; ValueError for arrays of a wrong shape.
        """
        drawing = controls if isinstance(controls, Drawing) else None
        controls = np.ascontiguousarray(controls if drawing is None else np.asarray(drawing.nominal)[None], dtype="<f4")
        if controls.ndim != 3 or controls.shape[2] != 2:
            raise ValueError(f"controls have shape {controls.shape}, expected (samples, horizon, 2)")
        names = _channel_names(channels)
        request = prediction_pb2.PredictRequest(
            session_id=session_id,
            start=None if start is None else t.state_message(start, "start"),
            history_use=prediction_pb2.HISTORY_USE_MEASURED if use_history else prediction_pb2.HISTORY_USE_NONE,
            samples=controls.shape[0] if drawing is None else drawing.samples,
            horizon=controls.shape[1],
            controls=controls.tobytes() if drawing is None else b"",
            drawing=None if drawing is None else drawing.message(),
            cost=None if cost is None else cost.message(),
            output=prediction_pb2.OutputSelection(
                channels=sum(1 << CHANNELS.index(name) for name in names),
                stride=stride,
                wheel_sinkage=wheel_sinkage,
                precision=prediction_pb2.PRECISION_F16 if half else prediction_pb2.PRECISION_F32,
            ),
            start_stamp_ns=start_stamp_ns,
            sent=[
                prediction_pb2.SentCommand(stamp_ns=stamp_ns, command=types_pb2.Control(speed_m_s=command[0], second=command[1]))
                for stamp_ns, command in sent
            ],
            extras=None if extras is None else extras.message(),
        )
        try:
            reply = self._call(self._prediction.Predict, request, timeout_s)
        except (DeadlineExceeded, Overloaded, Unavailable) as error:
            known = start if start is not None else self._known_states.get(session_id)
            if fallback is None or known is None:
                raise
            return _fallback_prediction(fallback, t.array(known, (12,), "start"), controls, names, stride, error)
        prediction = _prediction(reply, stride, controls.shape[1], extras)
        if start is None and start_stamp_ns is None:
            self._known_states[session_id] = prediction.start
        return prediction


class MeasurementStream:
    """One open stream: `send` returns the answer. Threads must not share it."""

    def __init__(self, client: Client):
        self._client = client
        self._outgoing: "queue.Queue[Optional[measurements_pb2.Measurement]]" = queue.Queue()
        self._closed = threading.Event()
        self._answers = client._measurements.Stream(iter(self._outgoing.get, None))

    def __enter__(self) -> "MeasurementStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, measurement: t.Measurement) -> t.Answer:
        """Sends one measurement and awaits its answer. Raises Unavailable when the stream has ended."""
        if self._closed.is_set():
            raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the measurement stream is closed")
        self._outgoing.put(_measurement_message(measurement))
        try:
            answer = _answer(next(self._answers))
        except StopIteration:
            raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the service ended the measurement stream") from None
        except grpc.RpcError as error:
            raise from_rpc(error) from None
        self._client._remember(measurement, answer)
        return answer

    def close(self) -> None:
        """Says that no more measurements come."""
        if not self._closed.is_set():
            self._closed.set()
            self._outgoing.put(None)


def _channel_names(channels: Optional[Sequence[str]]) -> Tuple[str, ...]:
    """The names in the order of CHANNELS; ValueError for an unknown or an empty selection."""
    if channels is None:
        return CHANNELS
    unknown = [name for name in channels if name not in CHANNELS]
    if unknown or not channels:
        raise ValueError(f"channels {list(channels)} must be some of {CHANNELS}")
    return tuple(name for name in CHANNELS if name in channels)


def _measurement_message(measurement: t.Measurement) -> measurements_pb2.Measurement:
    command = t.array(measurement.command, (2,), "command")
    wheels = None
    if measurement.wheel_speed_rad_s is not None or measurement.road_wheel_angle_rad is not None:
        wheels = measurements_pb2.WheelMeasurement(
            speed_rad_s=measurement.wheel_speed_rad_s, road_wheel_angle_rad=measurement.road_wheel_angle_rad
        )
    return measurements_pb2.Measurement(
        session_id=measurement.session_id,
        sequence=measurement.sequence,
        stamp_ns=measurement.stamp_ns,
        boot_id=measurement.boot_id,
        state=t.state_message(measurement.state),
        command=types_pb2.Control(speed_m_s=command[0], second=command[1]),
        wheels=wheels,
    )


def _answer(message: measurements_pb2.MeasurementAnswer) -> t.Answer:
    kind = message.WhichOneof("outcome") or "unknown"
    detail = getattr(message, kind) if kind in ("not_finite", "rejected") else None
    return t.Answer(
        outcome=kind.upper(),
        session_id=message.session_id,
        stamp_ns=message.stamp_ns,
        sequence=message.sequence,
        history_epoch=message.history_epoch,
        soil_epoch=message.soil_epoch,
        field=getattr(detail, "field", ""),
        message=getattr(detail, "message", ""),
        soil=t.soil(message.soil_correction) if message.HasField("soil_correction") else None,
        reordered=message.reordered,
        place=message.place,
        durable_place=message.durable_place,
        code=getattr(detail, "code", 0),
    )


def _session(message: sessions_pb2.Session) -> t.Session:
    card = message.vehicle
    return t.Session(
        session_id=message.session_id,
        vehicle_id=message.vehicle_id,
        vehicle=t.VehicleCard(
            name=card.name,
            second_kind=_SECOND_KINDS.get(card.second, "unspecified"),
            speed_range_m_s=(card.speed_min_m_s, card.speed_max_m_s),
            second_range=(card.second_min, card.second_max),
            wheelbase_m=card.wheelbase_m,
            road_wheel_angle_max_rad=card.road_wheel_angle_max_rad,
        ),
        provenance=t.provenance(message.provenance),
        history_steps=message.history_steps,
        last_stamp_ns=message.last_stamp_ns if message.HasField("last_stamp_ns") else None,
        last_sequence=message.last_sequence if message.HasField("last_sequence") else None,
        state=t.state_array(message.state) if message.HasField("state") else None,
        command=np.array([message.command.speed_m_s, message.command.second]) if message.HasField("command") else None,
        soil=t.soil(message.soil_correction),
        boot_id=message.boot_id if message.HasField("boot_id") else None,
        vehicle_alive=message.vehicle_alive if message.HasField("vehicle_alive") else None,
        accepted=message.accepted,
        durable_place=message.durable_place,
        effects=tuple(_effect(effect) for effect in message.effects),
        effects_source=message.effects_source,
        alarm=_alarm(message.alarm) if message.HasField("alarm") else None,
    )


def _parameter_messages(effect: t.Effect) -> List[effects_pb2.EffectParameter]:
    return [effects_pb2.EffectParameter(name=name, value=value, sd=effect.sd.get(name, 0.0)) for name, value in effect.parameters.items()]


def _effect(message: effects_pb2.Effect) -> t.Effect:
    return t.Effect(
        id=message.id,
        parameters={p.name: p.value for p in message.parameters},
        sd={p.name: p.sd for p in message.parameters if p.sd > 0.0},
    )


def _alarm(message: alarms_pb2.Alarm) -> t.Alarm:
    return t.Alarm(
        session_id=message.session_id,
        vehicle_id=message.vehicle_id,
        episode=message.episode,
        active=message.active,
        kind=alarms_pb2.AlarmKind.Name(message.kind)[len("ALARM_KIND_") :].lower(),
        channel=message.channel,
        size=message.size,
        statistic=message.statistic,
        threshold=message.threshold,
        stamp_ns=message.stamp_ns,
        onset_stamp_ns=message.onset_stamp_ns,
        soil_share=message.soil_share,
        description=message.description,
        diagnose=message.diagnose,
    )


def _tile(row: int, column: int, elevation: np.ndarray, rgb: Optional[np.ndarray]) -> terrain_pb2.MapTile:
    if elevation.ndim != 2:
        raise ValueError(f"elevation_m has shape {elevation.shape}, expected (rows, columns)")
    colours = b""
    if rgb is not None:
        rgb = np.ascontiguousarray(rgb, dtype=np.uint8)
        if rgb.shape != (*elevation.shape, 3):
            raise ValueError(f"semantic_rgb has shape {rgb.shape}, expected {(*elevation.shape, 3)}")
        colours = rgb.tobytes()
    rows, columns = elevation.shape
    return terrain_pb2.MapTile(
        row=row, column=column, rows=rows, columns=columns, elevation_m=elevation.tobytes(), semantic_rgb=colours
    )


def _upload_messages(world: t.WorldMap, elevation: np.ndarray) -> Iterator[terrain_pb2.UploadMapRequest]:
    height, width = elevation.shape
    rows = max(1, _TILE_CELLS // max(1, width))
    tiles = [
        _tile(row, 0, elevation[row : row + rows], None if world.semantic_rgb is None else world.semantic_rgb[row : row + rows])
        for row in range(0, height, rows)
    ]
    header = terrain_pb2.MapHeader(
        map_id=world.map_id,
        version=world.version,
        origin_x_m=world.origin_m[0],
        origin_y_m=world.origin_m[1],
        resolution_m=world.resolution_m,
        width=width,
        height=height,
        semantic=world.semantic_rgb is not None,
    )
    return iter([terrain_pb2.UploadMapRequest(header=header), *(terrain_pb2.UploadMapRequest(tile=tile) for tile in tiles)])


def _map_description(message: terrain_pb2.MapDescription) -> t.MapDescription:
    return t.MapDescription(
        map_id=message.map_id,
        version=message.version,
        hash=message.hash,
        origin_m=(message.origin_x_m, message.origin_y_m),
        resolution_m=message.resolution_m,
        width=message.width,
        height=message.height,
        semantic=message.semantic,
    )


def _steps_s(steps: int, stride: int) -> np.ndarray:
    return 0.1 * max(1, stride) * np.arange(1, steps + 1)


def _prediction(reply: prediction_pb2.PredictReply, stride: int, horizon: int, extras: Optional[Extras]) -> t.Prediction:
    channels = tuple(name for i, name in enumerate(CHANNELS) if reply.channels >> i & 1)
    what_if = extras is not None and extras.what_if
    ranked = ranking(reply)
    rows = (reply.soil_groups, reply.samples) if what_if else (reply.samples if ranked is None else len(ranked.best),)
    shape = (*rows, reply.steps, len(channels))
    start = t.state_array(reply.start)
    half = reply.precision == prediction_pb2.PRECISION_F16
    width = "<f2" if half else "<f4"
    states = np.frombuffer(reply.states, dtype=width).reshape(shape).astype(np.float32, copy=False)
    if half:
        # Positions travel as offsets from the start.
        states = (states + [start[i] if i < 3 else 0.0 for i in map(CHANNELS.index, channels)]).astype(np.float32)
    sinkage = None
    if reply.sinkage_m:
        sinkage = np.frombuffer(reply.sinkage_m, dtype=width).reshape(*rows, reply.steps, 4).astype(np.float32, copy=False)
    return t.Prediction(
        states=states,
        channels=channels,
        steps_s=_steps_s(reply.steps, stride),
        validity=np.array(reply.validity, dtype=np.uint32).reshape(rows),
        start=start,
        sinkage_m=sinkage,
        history_steps=reply.history_steps,
        soil=t.soil_array(reply.soil),
        soil_variance=t.soil_array(reply.soil_variance) if reply.HasField("soil_variance") else None,
        measurement_age_s=reply.measurement_age_s if reply.HasField("measurement_age_s") else None,
        provenance=t.provenance(reply.provenance),
        queue_s=reply.queue_s,
        compute_s=reply.compute_s,
        start_stamp_ns=reply.start_stamp_ns if reply.HasField("start_stamp_ns") else None,
        rolled_forward_steps=reply.rolled_forward_steps,
        soil_correction=t.soil(reply.soil_correction),
        extras=None if extras is None else extra_outputs(reply, horizon, what_if),
        controls=np.frombuffer(reply.drawn_controls, dtype="<f4").reshape(-1, horizon, 2) if reply.drawn_controls else None,
        ranking=ranked,
    )


def _fallback_prediction(
    fallback: KinematicFallback, start: np.ndarray, controls: np.ndarray, names: Tuple[str, ...], stride: int, reason: NesamError
) -> t.Prediction:
    stride = max(1, stride)
    states = fallback.rollout(start, controls)[:, stride - 1 :: stride][:, :, [CHANNELS.index(name) for name in names]]
    return t.Prediction(
        states=states,
        channels=names,
        steps_s=_steps_s(states.shape[1], stride),
        validity=np.zeros(len(states), dtype=np.uint32),
        start=start,
        sinkage_m=None,
        history_steps=0,
        soil=None,
        soil_variance=None,
        measurement_age_s=None,
        provenance=None,
        queue_s=0.0,
        compute_s=0.0,
        computed_by="kinematic_fallback",
        fallback_reason=reason,
    )
