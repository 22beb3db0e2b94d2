"""A declared fallback for planners that must have an answer."""

from dataclasses import dataclass
from typing import Optional, Sequence, Tuple

import numpy as np

from ._types import VehicleCard

ROLLED_FORWARD_STEPS_MAX = 32
"""Steps that a known state is rolled forward at most, as in the service."""


@dataclass(frozen=True)
class KnownState:
    """A state of a session, its instant by the vehicle's clock (None for a start that was given) and the steps that it was rolled forward."""

    state: np.ndarray
    stamp_ns: Optional[int] = None
    rolled_forward_steps: int = 0


@dataclass(frozen=True)
class KinematicFallback:
    """Flat-ground kinematics of a vehicle card: the commanded speed is reached at once, a bicycle turns with tan(angle) / wheelbase, a skid-steer
    vehicle with the commanded yaw rate. It knows no terrain, soil or slip; height, roll and pitch stay those of the start. It is used only where a
    caller passes it to `Client.predict`, and the prediction says so in `computed_by`.
    """

    vehicle: VehicleCard
    dt_s: float = 0.1

    def yaw_rate_rad_s(self, speed_m_s: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Yaw rate that a command means."""
        if self.vehicle.second_kind == "yaw_rate_rad_s":
            return second
        normalised = self.vehicle.second_kind == "steering_normalised"
        angle = second * self.vehicle.road_wheel_angle_max_rad if normalised else second
        return speed_m_s * np.tan(angle) / self.vehicle.wheelbase_m

    def rollout(self, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """States (samples, horizon, 12) float32 from start (12,) and controls (samples, horizon, 2)."""
        samples, horizon, _ = controls.shape
        controls = controls.astype(np.float64)
        state = np.tile(np.asarray(start, dtype=np.float64), (samples, 1))
        states = np.empty((samples, horizon, 12), dtype=np.float32)
        for k in range(horizon):
            speed, second = controls[:, k, 0], controls[:, k, 1]
            state = self._step(state, speed, self.yaw_rate_rad_s(speed, second))
            states[:, k] = state
        return states

    def rolled_forward(self, known: KnownState, until_ns: int, sent: Sequence[Tuple[int, Sequence[float]]]) -> Optional[KnownState]:
        """A known state rolled forward to an instant, rounded to the nearest step; None where it is too old for that, and itself where it is later.

        Each step uses the command of `sent` that is in effect at its middle; before the first of them the vehicle goes on as it moves.
        """
        if known.stamp_ns is None:
            return known
        step_ns = max(1, round(self.dt_s * 1e9))
        steps = max(0, (2 * (until_ns - known.stamp_ns) + step_ns) // (2 * step_ns))
        if steps > ROLLED_FORWARD_STEPS_MAX:
            return None
        state = np.asarray(known.state, dtype=np.float64)[None]
        for k in range(steps):
            in_effect = [command for stamp_ns, command in sent if 2 * (stamp_ns - known.stamp_ns) <= (2 * k + 1) * step_ns]
            if in_effect:
                speed, second = (np.full(1, float(value)) for value in in_effect[-1])
                state = self._step(state, speed, self.yaw_rate_rad_s(speed, second))
            else:
                state = self._step(state, state[:, 6], state[:, 11])
        return KnownState(state[0], known.stamp_ns + steps * step_ns, steps)

    def _step(self, states: np.ndarray, speed: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """States (samples, 12) one step after `states` at speeds and yaw rates (samples,)."""
        after = states.copy()
        middle = states[:, 5] + 0.5 * rate * self.dt_s
        # Exact for an arc: the chord is speed dt sin(h) / h with h = half of the turned angle.
        chord = speed * self.dt_s * np.sinc(0.5 * rate * self.dt_s / np.pi)
        after[:, 0] += chord * np.cos(middle)
        after[:, 1] += chord * np.sin(middle)
        after[:, 5] = np.pi - np.mod(np.pi - (states[:, 5] + rate * self.dt_s), 2.0 * np.pi)
        after[:, 6:] = 0.0
        after[:, 6], after[:, 11] = speed, rate
        return after
