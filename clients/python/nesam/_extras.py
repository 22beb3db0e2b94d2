"""What a prediction may compute beyond states: Jacobians, covariance, risk, what-if soils."""

from dataclasses import dataclass
from typing import Optional, Tuple

import numpy as np

from ._given import unmasked
from .v1 import prediction_pb2


@dataclass(frozen=True, eq=False)
class Extras:
    """What to compute beyond the states; what is not asked for costs nothing.

    jacobians: derivatives of every state in start, commands and soil correction, with the terrain held as the rollout met it; at most 8 samples. covariance: of every state; at most 64 samples.
    start_covariance: (12, 12) of the start in the units of a state squared, default that of a measured state as the bundle knows it. risk: wheel loads and
    slips, load transfer, traction reserve. soil_deltas: (soils, 6) what-if corrections in the order k_phi k_c n c phi k_shear, added to the session's in its
    coordinates; `Prediction.states` then is (soils, samples, steps, channels). soil_sigma_points: thirteen such groups for the sigma points of what the session
    knows of the soil: the estimate first, then twelve with equal weights, +1, -1, +2, -2, ... of the columns of the Cholesky factor of its covariance. exact_terrain: encodes the terrain at every pose instead of interpolating on the pose
    grid; at most 16 samples. interpolation_deviation: how far that moves the first candidate; not together with exact_terrain. What-if soils do not go together
    with Jacobians, covariance and exact terrain.
    """

    jacobians: bool = False
    covariance: bool = False
    start_covariance: Optional[np.ndarray] = None
    risk: bool = False
    soil_deltas: Optional[np.ndarray] = None
    soil_sigma_points: bool = False
    exact_terrain: bool = False
    interpolation_deviation: bool = False

    @property
    def what_if(self) -> bool:
        """Whether the prediction has groups of trajectories, one for each soil."""
        return self.soil_deltas is not None or self.soil_sigma_points

    def message(self) -> prediction_pb2.PredictExtras:
        """As message. ValueError for an array of a wrong shape or with masked numbers."""
        return prediction_pb2.PredictExtras(
            jacobians=self.jacobians,
            covariance=self.covariance,
            start_covariance=_packed(self.start_covariance, (12, 12), "start_covariance"),
            risk=self.risk,
            soil_deltas=_packed(self.soil_deltas, (None, 6), "soil_deltas"),
            soil_sigma_points=self.soil_sigma_points,
            exact_terrain=self.exact_terrain,
            interpolation_deviation=self.interpolation_deviation,
        )


@dataclass(frozen=True, eq=False)
class ExtraOutputs:
    """What was computed beyond the states, float32; None where it was not asked for.

    State entries are x y z roll pitch yaw vx vy vz wx wy wz (World, velocities in Body) whatever `channels` says. jacobian_start: (samples, steps, 12, 12)
    in the measured or given state. jacobian_controls: (samples, steps, 12, horizon, 2). jacobian_soil: (samples, steps, 12, 6) in the session's
    correction. covariance: (samples, steps, 12, 12) of what would be measured. region_90_planar: 90 % of the measured (x, y) lie where d' P^-1 d is at most
    this, P the 2 x 2 block; region_90_single: (6,), the same for x y z roll pitch yaw alone; not without a map or off it. wheel_load_n, N, and wheel_slip, -1 to 1: (..., steps, 4)
    with the wheels front left, front right, rear left, rear right. load_transfer_ratio: (..., steps), 0 even to 1 one side carries nothing.
    traction_reserve: (..., steps), drawbar pull that is left over the weight in the direction of the speed command; below 0 the vehicle gets stuck, or does
    not start. `...` is (samples,), or (soils, samples) with what-if soils. interpolation_deviation_m: mean over the horizon of the horizontal distance between the first candidate and the same one with the terrain
    encoded at every pose; None without a map, too, where nothing is interpolated.
    """

    jacobian_start: Optional[np.ndarray] = None
    jacobian_controls: Optional[np.ndarray] = None
    jacobian_soil: Optional[np.ndarray] = None
    covariance: Optional[np.ndarray] = None
    region_90_planar: Optional[float] = None
    region_90_single: Optional[np.ndarray] = None
    wheel_load_n: Optional[np.ndarray] = None
    wheel_slip: Optional[np.ndarray] = None
    load_transfer_ratio: Optional[np.ndarray] = None
    traction_reserve: Optional[np.ndarray] = None
    interpolation_deviation_m: Optional[float] = None


def _packed(values: Optional[np.ndarray], shape: Tuple[Optional[int], ...], name: str) -> bytes:
    if values is None:
        return b""
    values = np.ascontiguousarray(unmasked(values, name), dtype="<f4")
    fits = values.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, values.shape)) and values.size > 0
    if not fits:
        raise ValueError(f"{name} has shape {values.shape}, expected {tuple('any' if n is None else n for n in shape)}")
    return values.tobytes()


def extra_outputs(reply: prediction_pb2.PredictReply, horizon: int, what_if: bool) -> ExtraOutputs:
    """What a reply carries beyond its states."""
    rows = (reply.soil_groups, reply.samples, reply.steps) if what_if else (reply.samples, reply.steps)
    single = (reply.samples, reply.steps)

    def unpack(packed: bytes, shape: Tuple[int, ...]) -> Optional[np.ndarray]:
        return np.frombuffer(packed, dtype="<f4").reshape(shape) if packed else None

    known = bool(reply.covariance)
    return ExtraOutputs(
        jacobian_start=unpack(reply.jacobian_start, (*single, 12, 12)),
        jacobian_controls=unpack(reply.jacobian_controls, (*single, 12, horizon, 2)),
        jacobian_soil=unpack(reply.jacobian_soil, (*single, 12, 6)),
        covariance=unpack(reply.covariance, (*single, 12, 12)),
        region_90_planar=reply.region_90_planar if known else None,
        region_90_single=np.array(reply.region_90_single) if known else None,
        wheel_load_n=unpack(reply.wheel_load_n, (*rows, 4)),
        wheel_slip=unpack(reply.wheel_slip, (*rows, 4)),
        load_transfer_ratio=unpack(reply.load_transfer_ratio, rows),
        traction_reserve=unpack(reply.traction_reserve, rows),
        interpolation_deviation_m=reply.interpolation_deviation_m if reply.HasField("interpolation_deviation_m") else None,
    )
