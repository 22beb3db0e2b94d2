"""A declared fallback for planners that must have an answer."""

from dataclasses import dataclass
from typing import Optional, Sequence, Tuple

import grpc
import numpy as np

from ._errors import InvalidArgument
from ._types import VehicleCard

ROLLED_FORWARD_STEPS_MAX = 32
"""Steps that a known state is rolled forward at most, as in the service."""


@dataclass(frozen=True)
class KnownState:
    """A state of a session, its instant by the vehicle's clock (None for a start that was given) and the steps from the newest measurement to it."""

    state: np.ndarray
    stamp_ns: Optional[int] = None
    rolled_forward_steps: int = 0


@dataclass(frozen=True)
class Known:
    """What is known of where a vehicle was: its newest measured state, and the state that the service last rolled forward from a measurement."""

    measured: Optional[KnownState] = None
    ahead: Optional[KnownState] = None


@dataclass(frozen=True)
class KinematicFallback:
    """Flat-ground kinematics of a vehicle card: the commanded speed is reached at once, a bicycle turns with tan(angle) / wheelbase, a skid-steer
    vehicle with the commanded yaw rate. It knows no terrain, soil or slip; height, roll and pitch stay those of the start. It is used only where a
    caller passes it to `Client.predict`, and the prediction says so in `computed_by`.
    """

    vehicle: VehicleCard
    dt_s: float = 0.1

    def check(self, controls: np.ndarray, sent: Sequence[Tuple[int, Sequence[float]]] = (), name: str = "controls") -> None:
        """Refuses commands as the service does: numbers that are not finite, and those outside the range of the vehicle card.

        controls: (samples, horizon, 2). sent: pairs (stamp_ns, (speed, second)) by ascending stamp. name: of `controls` in the error.

        Raises InvalidArgument; `field` names the first of them, as `controls[sample, step].speed_m_s` or `sent[i].command.second`.
        """
        controls = np.asarray(controls, dtype=np.float32)
        for sample, step in np.argwhere(~self._admits(controls).all(axis=2))[:1]:
            place, command = f"{name}[{sample}, {step}]", controls[sample, step]
            if not np.isfinite(command).all():
                raise invalid(place, "holds a number that is not finite")
            self._check_range(place, command)
        for i, (stamp_ns, command) in enumerate(sent):
            if i > 0 and stamp_ns <= sent[i - 1][0]:
                reason = f"is {stamp_ns}, not after the {sent[i - 1][0]} before it; give the commands by ascending stamp"
                raise invalid(f"sent[{i}].stamp_ns", reason)
            for entry, value in zip(_ENTRIES, command):
                if not np.isfinite(value):
                    raise invalid(f"sent[{i}].command.{entry}", f"is {value}, a finite number is needed")
            self._check_range(f"sent[{i}].command", command)

    def yaw_rate_rad_s(self, speed_m_s: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Yaw rate that a command means."""
        if self.vehicle.second_kind == "yaw_rate_rad_s":
            return second
        normalised = self.vehicle.second_kind == "steering_normalised"
        angle = second * self.vehicle.road_wheel_angle_max_rad if normalised else second
        return speed_m_s * np.tan(angle) / self.vehicle.wheelbase_m

    def rollout(self, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """States (samples, horizon, 12) float32 from start (12,) and controls (samples, horizon, 2), which are taken as they are; `check` refuses wrong ones."""
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
        """A known state rolled forward to an instant, rounded to the nearest step; None where it lies too far after the measurement, and itself where it is earlier.

        Each step uses the command of `sent` that is in effect at its middle; before the first of them the vehicle goes on as it moves.
        """
        if known.stamp_ns is None:
            return known
        step_ns = self._step_ns()
        steps = max(0, self._steps(known.stamp_ns, until_ns))
        if known.rolled_forward_steps + steps > ROLLED_FORWARD_STEPS_MAX:
            return None
        state = np.asarray(known.state, dtype=np.float64)[None]
        for k in range(steps):
            in_effect = [command for stamp_ns, command in sent if 2 * (stamp_ns - known.stamp_ns) <= (2 * k + 1) * step_ns]
            if in_effect:
                speed, second = (np.full(1, float(value)) for value in in_effect[-1])
                state = self._step(state, speed, self.yaw_rate_rad_s(speed, second))
            else:
                state = self._step(state, state[:, 6], state[:, 11])
        return KnownState(state[0], known.stamp_ns + steps * step_ns, known.rolled_forward_steps + steps)

    def begins(self, known: Known, until_ns: Optional[int], sent: Sequence[Tuple[int, Sequence[float]]]) -> Optional[KnownState]:
        """Where a prediction without a given start begins, None where nothing that is known serves. Without an instant it is the measured state. A state that the
        service rolled forward is no measurement: it serves where it is not later than the instant and no newer measurement is known."""
        measured, ahead = known.measured, known.ahead
        if until_ns is None:
            return measured or ahead
        if ahead is not None and ahead.stamp_ns is not None and self._steps(ahead.stamp_ns, until_ns) >= 0:
            since_ns = ahead.stamp_ns - ahead.rolled_forward_steps * self._step_ns()
            if measured is None or measured.stamp_ns is None or measured.stamp_ns <= since_ns:
                return self.rolled_forward(ahead, until_ns, sent)
        return None if measured is None else self.rolled_forward(measured, until_ns, sent)

    def _step_ns(self) -> int:
        return max(1, round(self.dt_s * 1e9))

    def _steps(self, from_ns: int, until_ns: int) -> int:
        """Steps between two instants, rounded to the nearest."""
        step_ns = self._step_ns()
        return (2 * (until_ns - from_ns) + step_ns) // (2 * step_ns)

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

    def _range(self) -> np.ndarray:
        """(2, 2) float32: lowest and highest speed and second command. In float32 the ends of the range are admitted in both precisions."""
        return np.array([self.vehicle.speed_range_m_s, self.vehicle.second_range], dtype=np.float32)

    def _admits(self, controls: np.ndarray) -> np.ndarray:
        """Whether each number (..., 2) lies in its range, as bool; NaN does not."""
        low, high = self._range().T
        return np.asarray((controls >= low) & (controls <= high))

    def _check_range(self, place: str, command: Sequence[float]) -> None:
        for entry, value, (low, high), admitted in zip(_ENTRIES, command, self._range(), self._admits(np.asarray(command, dtype=np.float32))):
            if not admitted:
                raise invalid(f"{place}.{entry}", f"is {value:g}, the card of {self.vehicle.name} admits {low:g} to {high:g}")


_ENTRIES = ("speed_m_s", "second")


def invalid(field: str, reason: str) -> InvalidArgument:
    """A refusal as that of the service."""
    return InvalidArgument(grpc.StatusCode.INVALID_ARGUMENT, field, f"`{field}`: {reason}")
