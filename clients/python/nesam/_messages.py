"""Messages to what users hold and back; the same for the clients of both kinds."""

from typing import Iterator, List, Optional, Sequence, Tuple

import numpy as np

from . import _types as t
from ._candidates import ranking
from ._errors import NesamError
from ._extras import Extras, extra_outputs
from ._fallback import KinematicFallback, KnownState
from ._given import stamp, unmasked, whole
from .v1 import alarms_pb2, effects_pb2, measurements_pb2, prediction_pb2, sessions_pb2, terrain_pb2, types_pb2

CHANNELS: Tuple[str, ...] = ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "wx", "wy", "wz")
"""Names of the channels of a state, in order."""

_SECOND_KINDS = {1: "steering_normalised", 2: "road_wheel_angle_rad", 3: "yaw_rate_rad_s"}
_TILE_CELLS = 256 << 10


def channel_names(channels: Optional[Sequence[str]]) -> Tuple[str, ...]:
    """The names in the order of CHANNELS; ValueError for an unknown or an empty selection."""
    if channels is None:
        return CHANNELS
    unknown = [name for name in channels if name not in CHANNELS]
    if unknown or not channels:
        raise ValueError(f"channels {list(channels)} must be some of {CHANNELS}")
    return tuple(name for name in CHANNELS if name in channels)


def _of_wheels(values: Optional[t.Vector], count: int, name: str) -> Optional[np.ndarray]:
    """One number of each wheel, None where they are not measured; ValueError for another count, which a service would refuse, or end the stream for."""
    return None if values is None else t.array(values, (count,), name)


def measurement_message(measurement: t.Measurement) -> measurements_pb2.Measurement:
    """A measurement as message. ValueError for an array of a wrong shape or with masked numbers, and a number that does not fit."""
    command = t.array(measurement.command, (2,), "command")
    wheels = None
    if measurement.wheel_speed_rad_s is not None or measurement.road_wheel_angle_rad is not None:
        wheels = measurements_pb2.WheelMeasurement(
            speed_rad_s=_of_wheels(measurement.wheel_speed_rad_s, 4, "wheel_speed_rad_s"),
            road_wheel_angle_rad=_of_wheels(measurement.road_wheel_angle_rad, 2, "road_wheel_angle_rad"),
        )
    return measurements_pb2.Measurement(
        session_id=measurement.session_id,
        sequence=whole(measurement.sequence, "sequence", bits=64),
        stamp_ns=stamp(measurement.stamp_ns),
        boot_id=whole(measurement.boot_id, "boot_id", bits=64),
        run=whole(measurement.run, "run", bits=64),
        state=t.state_message(measurement.state),
        command=types_pb2.Control(speed_m_s=command[0], second=command[1]),
        wheels=wheels,
    )


def answer(message: measurements_pb2.MeasurementAnswer) -> t.Answer:
    """What became of a measurement."""
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
        run=message.run,
        code=getattr(detail, "code", 0),
        map_version=message.map_version,
        bundle_hash=message.bundle_hash,
    )


def session(message: sessions_pb2.Session) -> t.Session:
    """A session as the service describes it."""
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
        run=message.run,
        effects=tuple(effect(one) for one in message.effects),
        effects_source=message.effects_source,
        alarm=alarm(message.alarm) if message.HasField("alarm") else None,
        forecasts=forecast_check(message.forecasts) if message.HasField("forecasts") else None,
    )


def forecast_check(message: sessions_pb2.ForecastCheck) -> t.ForecastCheck:
    """How predictions came true."""
    return t.ForecastCheck(
        checked=message.checked,
        error_rms_m=np.array(message.error_rms_m),
        expected_rms_m=np.array(message.expected_rms_m),
        scale=message.scale,
        height_scale=message.height_scale,
    )


def parameter_messages(effect: t.Effect) -> List[effects_pb2.EffectParameter]:
    """The parameters of an effect as messages."""
    return [effects_pb2.EffectParameter(name=name, value=value, sd=effect.sd.get(name, 0.0)) for name, value in effect.parameters.items()]


def effect(message: effects_pb2.Effect) -> t.Effect:
    """An effect that acts in a session."""
    return t.Effect(
        id=message.id,
        parameters={p.name: p.value for p in message.parameters},
        sd={p.name: p.sd for p in message.parameters if p.sd > 0.0},
    )


def alarm(message: alarms_pb2.Alarm) -> t.Alarm:
    """An alarm that was raised or cleared."""
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


def tile(row: int, column: int, elevation: np.ndarray, rgb: Optional[np.ndarray]) -> terrain_pb2.MapTile:
    """A rectangle of a map whose south-west cell is (row, column)."""
    if elevation.ndim != 2:
        raise ValueError(f"elevation_m has shape {elevation.shape}, expected (rows, columns)")
    colours = b""
    if rgb is not None:
        if np.asarray(rgb).dtype != np.uint8:
            raise ValueError(f"semantic_rgb is of {np.asarray(rgb).dtype}, expected uint8 (0 to 255 for red, green and blue)")
        rgb = np.ascontiguousarray(unmasked(rgb, "semantic_rgb"))
        if rgb.shape != (*elevation.shape, 3):
            raise ValueError(f"semantic_rgb has shape {rgb.shape}, expected {(*elevation.shape, 3)}")
        colours = rgb.tobytes()
    rows, columns = elevation.shape
    return terrain_pb2.MapTile(
        row=whole(row, "row"), column=whole(column, "column"), rows=rows, columns=columns, elevation_m=elevation.tobytes(), semantic_rgb=colours
    )


def upload_messages(world: t.WorldMap, elevation: np.ndarray) -> Iterator[terrain_pb2.UploadMapRequest]:
    """A map in tiles, after its header."""
    height, width = elevation.shape
    if world.semantic_rgb is not None and np.shape(world.semantic_rgb)[:2] != elevation.shape:
        raise ValueError(f"semantic_rgb has shape {np.shape(world.semantic_rgb)}, expected {(*elevation.shape, 3)}")
    rows = max(1, _TILE_CELLS // max(1, width))
    tiles = [
        tile(row, 0, elevation[row : row + rows], None if world.semantic_rgb is None else world.semantic_rgb[row : row + rows])
        for row in range(0, height, rows)
    ]
    header = terrain_pb2.MapHeader(
        map_id=world.map_id,
        version=whole(world.version, "version", bits=64),
        origin_x_m=world.origin_m[0],
        origin_y_m=world.origin_m[1],
        resolution_m=world.resolution_m,
        width=width,
        height=height,
        semantic=world.semantic_rgb is not None,
        stamp_ns=None if world.stamp_ns is None else stamp(world.stamp_ns),
        frame=world.frame,
    )
    return iter([terrain_pb2.UploadMapRequest(header=header), *(terrain_pb2.UploadMapRequest(tile=tile) for tile in tiles)])


def map_description(message: terrain_pb2.MapDescription) -> t.MapDescription:
    """A map as the service describes it."""
    return t.MapDescription(
        map_id=message.map_id,
        version=message.version,
        hash=message.hash,
        origin_m=(message.origin_x_m, message.origin_y_m),
        resolution_m=message.resolution_m,
        width=message.width,
        height=message.height,
        semantic=message.semantic,
        stamp_ns=message.stamp_ns if message.HasField("stamp_ns") else None,
        frame=message.frame,
    )


def steps_s(steps: int, stride: int) -> np.ndarray:
    return 0.1 * max(1, stride) * np.arange(1, steps + 1)


def prediction(reply: prediction_pb2.PredictReply, stride: int, horizon: int, extras: Optional[Extras]) -> t.Prediction:
    """A reply in arrays."""
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
        steps_s=steps_s(reply.steps, stride),
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


def fallback_prediction(
    fallback: KinematicFallback, start: KnownState, controls: np.ndarray, names: Tuple[str, ...], stride: int, reason: NesamError
) -> t.Prediction:
    """What a fallback answers instead of the service, and why."""
    stride = max(1, stride)
    states = fallback.rollout(start.state, controls)[:, stride - 1 :: stride][:, :, [CHANNELS.index(name) for name in names]]
    return t.Prediction(
        states=states,
        channels=names,
        steps_s=steps_s(states.shape[1], stride),
        validity=np.zeros(len(states), dtype=np.uint32),
        start=start.state,
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
        start_stamp_ns=start.stamp_ns,
        rolled_forward_steps=start.rolled_forward_steps,
    )
