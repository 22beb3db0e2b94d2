"""What goes in and what comes out. What holds arrays is equal to itself alone: whether arrays are equal is no yes or no."""

import enum
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np
import numpy.typing as npt

from ._candidates import Ranking
from ._extras import ExtraOutputs
from ._given import unmasked
from .v1 import soil_pb2, types_pb2


Vector = Union[Sequence[float], "npt.NDArray[Any]"]
"""A list, a tuple or a one-dimensional array of numbers."""


class Validity(enum.IntFlag):
    """What there is to say against a predicted sample; 0 = nothing."""

    NOT_FINITE = 1
    OFF_MAP = 2
    NO_MAP = 4
    SPEED_UNTRAINED = 8
    STEERING_UNTRAINED = 16
    SLOPE_UNTRAINED = 32
    OVERTURNED = 64
    SOIL_NOT_LEARNED = 128
    ALARM_ACTIVE = 256
    START_OFF_GROUND = 512


@dataclass(frozen=True)
class VehicleCard:
    """The part of the vehicle card that a client needs.

    second_kind: what the second command is, positive to the left: steering_normalised (-1 to 1), road_wheel_angle_rad or yaw_rate_rad_s (of a skid-steer vehicle).
    speed_range_m_s, second_range: lowest and highest command that is admitted, the second in the unit of its kind. road_wheel_angle_max_rad: mean of left and
    right at the highest second command, 0 for a vehicle that does not steer its wheels.
    """

    name: str
    second_kind: str
    speed_range_m_s: Tuple[float, float]
    second_range: Tuple[float, float]
    wheelbase_m: float
    road_wheel_angle_max_rad: float


@dataclass(frozen=True)
class Provenance:
    """What a reply was computed from.

    history_epoch: changes of the session's history, 0 = no measurement yet. soil_epoch: changes of its soil correction, 0 = none yet. map_id: "" = no map. map_hash:
    SHA-256 (hex) of its layers. bundle_hash: SHA-256 (hex) of the manifest of the model bundle.
    """

    history_epoch: int
    soil_epoch: int
    map_id: str
    map_version: int
    map_hash: str
    bundle_name: str
    bundle_hash: str


@dataclass(frozen=True, eq=False)
class Soil:
    """What a session knows of the soil: a correction of the prior in the order k_phi k_c n c phi k_shear.

    coordinates: "logarithmic" (natural logarithm of the factor; differences for n and phi) or "physical" (SI). delta: (6,). covariance: (6, 6) or
    None while no filter runs. learned: (6,) bool, whether the drive has at least halved the prior variance of each, with a correction that is more likely
    right than the prior alone.
    """

    coordinates: str
    delta: np.ndarray
    covariance: Optional[np.ndarray]
    learned: np.ndarray


@dataclass(frozen=True, eq=False)
class SoilEstimate:
    """What a session knows of the soil after a change. soil_epoch counts the changes, 0 = none yet: updates, and beginnings anew from the prior (effects were
    applied or reverted) or from the fleet's soil. stamp_ns: last measurement that went in, of the vehicle's clock, None where none has since the beginning.
    history_epoch, map_version (0 = no map) and bundle_hash: where the session stood then.
    """

    session_id: str
    soil_epoch: int
    stamp_ns: Optional[int]
    soil: Soil
    history_epoch: int = 0
    map_version: int = 0
    bundle_hash: str = ""


@dataclass(frozen=True, eq=False)
class SoilCell:
    """Evidence of the fleet on one cell of ground that looks alike, without any prior, in the coordinates of `Soil`.

    colour_rgb: (3,) uint8, of the semantic map in steps of 16 levels. cell: (column, row) = floor(position / cell_m) in World. information: (6, 6). vector: (6,),
    information times mean. buffers: buffers of a filter that went in, aged to the last one, age_s ago.
    """

    map_id: str
    colour_rgb: np.ndarray
    cell: Tuple[int, int]
    information: np.ndarray
    vector: np.ndarray
    buffers: float
    age_s: float


@dataclass(frozen=True, eq=False)
class FleetSoil:
    """What the fleet has learned of the ground: edge of a cell in m, and the cells by map, colour and place."""

    cell_m: float
    cells: List[SoilCell]


@dataclass(frozen=True)
class Effect:
    """A physical effect of the catalogue (docs/effects.md): every parameter by name in the unit of the catalogue, and the standard deviations of those that have one."""

    id: str
    parameters: Dict[str, float]
    sd: Dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Alarm:
    """An episode in which the measurements of a session disagree with its predictions; `active` is False when it has ended.

    kind: nis_large, nis_small, correlated, motion_jump or sensor_jump. channel: what jumped, "" for a test of all. size: mean of the channel since the onset, in
    the unit that its name ends in, measured minus predicted. statistic: of the test that raised it, beyond threshold. soil_share: share of the misfit that
    another soil could explain at most, 0 to 1. onset_stamp_ns: from which on it disagrees, stamp_ns: of the last measurement that was seen, both of the
    vehicle's clock. description: what it looks like, in one sentence. diagnose: command that diagnoses the recorded window, RECORDING stands for the recording
    of the server.
    """

    session_id: str
    vehicle_id: str
    episode: int
    active: bool
    kind: str
    channel: str
    size: float
    statistic: float
    threshold: float
    stamp_ns: int
    onset_stamp_ns: int
    soil_share: float
    description: str
    diagnose: str


@dataclass(frozen=True)
class DiagnosisStarted:
    """A diagnosis has begun. recording: the one that is read. Stamps: the window as it was asked for, None = to its end."""

    diagnosis_id: str
    recording: str
    from_stamp_ns: Optional[int]
    to_stamp_ns: Optional[int]


@dataclass(frozen=True)
class DiagnosisProgress:
    """How far a stage of a diagnosis is: `done` of `total` parts."""

    stage: str
    done: int
    total: int


@dataclass(frozen=True)
class DiagnosisReport:
    """What a diagnosis found. verdict: none, explained, ambiguous or unexplained, and why in `reason` (docs/read-a-diagnosis.md). effects: what is claimed, ready for
    `Client.apply_effects`. json: the whole report, schema nesam.diagnose/1. folder, bundle: where the server has the reports and the patched bundle; "" = none.
    """

    diagnosis_id: str
    verdict: str
    reason: str
    effects: Tuple[Effect, ...]
    json: str
    folder: str
    bundle: str
    bundle_hash: str
    notes: Tuple[str, ...]


DiagnosisEvent = Union[DiagnosisStarted, DiagnosisProgress, DiagnosisReport]


@dataclass(frozen=True, eq=False)
class ForecastCheck:
    """Predictions of a session held against what was measured in the end, one every 3.2 s.

    checked: comparisons so far. error_rms_m, expected_rms_m: (3,), root mean square of the distance in (x, y) after 0.8, 1.6 and 3.2 s over about the last
    minute, as measured and as bundle and soil filter expected it. scale, height_scale: how many times the model's part of predicted covariances counts for it,
    that of the height by how predicted heights came true, all else by (x, y).
    """

    checked: int
    error_rms_m: np.ndarray
    expected_rms_m: np.ndarray
    scale: float
    height_scale: float


@dataclass(frozen=True, eq=False)
class Session:
    """A session as the service holds it. `state` is (12,), `command` is (2,), of the newest step of 0.1 s; both are None before the first measurement.

    last_stamp_ns: of the newest measurement, which is up to 0.1 s later than that step where the vehicle measures faster.
    boot_id: start of the vehicle's software, None when it does not tell. vehicle_alive: whether the vehicle's Zenoh token is there, None without Zenoh.
    accepted: measurements accepted so far; durable_place: how many of them survive a crash of the server, 0 where it keeps no store; run: which server in
    which run counts them.
    effects: those that were applied on top of the bundle's, effects_source: where they come from. alarm: the active one, None without.
    forecasts: how predictions came true, None before the first comparison.
    """

    session_id: str
    vehicle_id: str
    vehicle: VehicleCard
    provenance: Provenance
    history_steps: int
    last_stamp_ns: Optional[int]
    last_sequence: Optional[int]
    state: Optional[np.ndarray]
    command: Optional[np.ndarray]
    soil: Soil
    boot_id: Optional[int] = None
    vehicle_alive: Optional[bool] = None
    accepted: int = 0
    durable_place: int = 0
    effects: Tuple[Effect, ...] = ()
    effects_source: str = ""
    alarm: Optional[Alarm] = None
    run: int = 0
    forecasts: Optional[ForecastCheck] = None


@dataclass(frozen=True)
class Tls:
    """TLS of a client, PEM as bytes: the authority of the server's certificate, and the client's own certificate and key where the server wants to
    know who it is. server_name: name in the server's certificate, "" = that of the address."""

    authority: bytes
    certificate: Optional[bytes] = None
    key: Optional[bytes] = field(default=None, repr=False)
    server_name: str = ""

    @classmethod
    def from_files(cls, authority: str, certificate: Optional[str] = None, key: Optional[str] = None, server_name: str = "") -> "Tls":
        """Reads the files. Raises OSError naming the one that cannot be read."""
        given = [None if path is None else Path(path).read_bytes() for path in (certificate, key)]
        return cls(Path(authority).read_bytes(), given[0], given[1], server_name)


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a vehicle measures at one instant.

    state: (12,), pose in World, twist in Body. command: (speed m/s, second in the unit of the vehicle card), applied from this instant on.
    stamp_ns: the vehicle's clock. sequence: 0 = not numbered. boot_id: any number that differs from start to start of the vehicle's software, 0 = not
    told; another one begins a new history and keeps the soil. run: `Answer.run` of the answers so far, 0 = whatever it is; where the session is at another
    run now it is REJECTED for `run`, and what is not durable is to be sent again (a `DurableStream` sees to that itself).
    wheel_speed_rad_s: (4,) FL FR RL RR; road_wheel_angle_rad: (2,) left, right.
    """

    session_id: str
    stamp_ns: int
    state: Vector
    command: Vector
    sequence: int = 0
    wheel_speed_rad_s: Optional[Vector] = None
    road_wheel_angle_rad: Optional[Vector] = None
    boot_id: int = 0
    run: int = 0


@dataclass(frozen=True, eq=False)
class Answer:
    """The service's answer to one measurement.

    outcome: APPLIED, BUFFERED, GATED, GAP, CLOCK_JUMP or RESTARTED, which changed the session, or DUPLICATE, TOO_OLD, FUTURE, NOT_FINITE or REJECTED, which
    did not. reordered: it arrived after a later one and was put in its place.
    field and message say what was wrong with a NOT_FINITE or REJECTED one, code is its gRPC number. soil: after this measurement, None when it was
    rejected. place: of the measurement among the accepted ones, 0 when it was refused; it survives a crash of the server as soon as a durable_place
    reaches it, which is 0 where the server keeps no store. run: which server in which run counts; places of different runs say nothing of each other.
    history_epoch, soil_epoch, map_version (0 = no map), bundle_hash: where the session stands after it; 0 and "" for a REJECTED one whose session was not
    looked at, as it is not open, not the sender's, or the service overloaded.
    """

    outcome: str
    session_id: str
    stamp_ns: int
    sequence: int
    history_epoch: int
    soil_epoch: int
    field: str = ""
    message: str = ""
    soil: Optional[Soil] = None
    reordered: bool = False
    place: int = 0
    durable_place: int = 0
    code: int = 0
    run: int = 0
    map_version: int = 0
    bundle_hash: str = ""


@dataclass(frozen=True, eq=False)
class WorldMap:
    """A map to upload; row 0 is the southernmost.

    elevation_m: (height, width) float32, m in World, NaN or masked = hole. semantic_rgb: (height, width, 3) uint8 or None. origin_m: World position of cell (0, 0).
    stamp_ns: instant that it was made at, of the vehicle's clock; frame: as its source names it, at most 64 bytes, "" = World. Both are carried for those who
    read the map, nothing is computed from them.
    """

    map_id: str
    elevation_m: np.ndarray
    resolution_m: float
    origin_m: Tuple[float, float] = (0.0, 0.0)
    semantic_rgb: Optional[np.ndarray] = None
    version: int = 1
    stamp_ns: Optional[int] = None
    frame: str = ""


@dataclass(frozen=True)
class MapDescription:
    """A map on the service, without its layers. hash: SHA-256 (hex) of them. width, height: columns and rows. semantic: whether it has colours."""

    map_id: str
    version: int
    hash: str
    origin_m: Tuple[float, float]
    resolution_m: float
    width: int
    height: int
    semantic: bool
    stamp_ns: Optional[int] = None
    frame: str = ""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted trajectories.

    Arrays may be read-only: copy what you change.

    states: (samples, steps, channels) float32, m and rad in World (yaw in (-pi, pi]), m/s and rad/s in Body. channels: names of the channels, in the order of
    CHANNELS. steps_s: (steps,) time of each returned step after the start, s. sinkage_m: (samples, steps, 4) float32, wheels front left, front right, rear
    left, rear right; None unless asked for. validity: (samples,) uint32 of `Validity` bits. start: (12,), given, measured or rolled forward. history_steps:
    measured steps before the start, 0 to 31. measurement_age_s: from the arrival of the newest measurement to the computation, None before the first. queue_s,
    compute_s: how long the request waited and the engine computed, s. start_stamp_ns: instant of the start by the vehicle's clock, None when a start was given.
    rolled_forward_steps: steps of 0.1 s from the newest measurement to the start. soil: (6,) k_phi k_c n c phi k_shear under the start, N/m^(n+2), N/m^(n+1),
    -, Pa, rad, m; soil_variance: (6,), of these squared, or None while no filter runs; soil_correction: what the session knew of the soil. extras: what
    `Extras` asked for; with what-if soils, states, sinkage_m and validity have a first dimension more, one group for each soil. controls: (samples, horizon, 2)
    float32 of candidates that the service drew, None of those that were sent. ranking: with a `PathCost`, the costs of all candidates; states, validity,
    sinkage_m and controls then have the rows of `ranking.best`. computed_by: "service", or "kinematic_fallback" when the service did not answer in time and a
    fallback was given; then soil, provenance, sinkage_m, extras and ranking are None, validity is 0, controls of a drawing are its nominal sequence alone, and
    `fallback_reason` is the service's error.
    """

    states: np.ndarray
    channels: Tuple[str, ...]
    steps_s: np.ndarray
    validity: np.ndarray
    start: np.ndarray
    sinkage_m: Optional[np.ndarray]
    history_steps: int
    soil: Optional[np.ndarray]
    soil_variance: Optional[np.ndarray]
    measurement_age_s: Optional[float]
    provenance: Optional[Provenance]
    queue_s: float
    compute_s: float
    computed_by: str = "service"
    fallback_reason: Optional[Exception] = None
    start_stamp_ns: Optional[int] = None
    rolled_forward_steps: int = 0
    soil_correction: Optional[Soil] = None
    extras: Optional[ExtraOutputs] = None
    controls: Optional[np.ndarray] = None
    ranking: Optional[Ranking] = None


def array(values: Vector, shape: Tuple[int, ...], name: str) -> np.ndarray:
    """`values` as float64 of the given shape; ValueError naming it otherwise, also with masked numbers."""
    result = np.asarray(unmasked(values, name), dtype=np.float64)
    if result.shape != shape:
        raise ValueError(f"{name} has shape {result.shape}, expected {shape}")
    return result


def state_message(state: Vector, name: str = "state") -> types_pb2.VehicleState:
    """A state message from (12,)."""
    x = array(state, (12,), name)
    parts = [types_pb2.Vector3(x=x[i], y=x[i + 1], z=x[i + 2]) for i in (0, 3, 6, 9)]
    return types_pb2.VehicleState(
        position_m=parts[0], attitude_rad=parts[1], velocity_m_s=parts[2], angular_velocity_rad_s=parts[3]
    )


def state_array(message: types_pb2.VehicleState) -> np.ndarray:
    """(12,) from a state message."""
    parts = (message.position_m, message.attitude_rad, message.velocity_m_s, message.angular_velocity_rad_s)
    return np.array([value for part in parts for value in (part.x, part.y, part.z)])


def soil_array(message: types_pb2.SoilVector) -> np.ndarray:
    """(6,) from a soil message."""
    return np.array([message.k_phi, message.k_c, message.n, message.c_pa, message.phi_rad, message.k_shear_m])


def soil(message: types_pb2.SoilCorrection) -> Soil:
    """What is known of the soil from its message."""
    return Soil(
        coordinates={1: "physical", 2: "logarithmic"}.get(message.coordinates, "unspecified"),
        delta=soil_array(message.delta),
        covariance=np.array(message.covariance).reshape(6, 6) if message.covariance else None,
        learned=np.array(message.learned, dtype=bool),
    )


def soil_estimate(message: soil_pb2.SoilEstimate) -> SoilEstimate:
    """An estimate from its message."""
    stamp_ns = message.stamp_ns if message.HasField("stamp_ns") else None
    return SoilEstimate(
        session_id=message.session_id,
        soil_epoch=message.soil_epoch,
        stamp_ns=stamp_ns,
        soil=soil(message.correction),
        history_epoch=message.history_epoch,
        map_version=message.map_version,
        bundle_hash=message.bundle_hash,
    )


def fleet_soil(message: soil_pb2.FleetSoilMap) -> FleetSoil:
    """The soil map of the fleet from its message."""

    def cell(one: soil_pb2.FleetSoilCell) -> SoilCell:
        return SoilCell(
            map_id=one.map_id,
            colour_rgb=np.array([one.colour_rgb >> shift & 0xFF for shift in (16, 8, 0)], np.uint8),
            cell=(one.column, one.row),
            information=np.array(one.information).reshape(6, 6),
            vector=soil_array(one.vector),
            buffers=one.buffers,
            age_s=one.age_s,
        )

    return FleetSoil(message.cell_m, [cell(one) for one in message.cells])


def provenance(message: types_pb2.Provenance) -> Provenance:
    """Provenance from its message."""
    return Provenance(
        history_epoch=message.history_epoch,
        soil_epoch=message.soil_epoch,
        map_id=message.map_id,
        map_version=message.map_version,
        map_hash=message.map_hash,
        bundle_name=message.bundle_name,
        bundle_hash=message.bundle_hash,
    )
