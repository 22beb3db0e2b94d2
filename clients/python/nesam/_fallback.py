"""A declared fallback for planners that must have an answer."""

from dataclasses import dataclass

import numpy as np

from ._types import VehicleCard


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
        states = np.tile(np.asarray(start, dtype=np.float64), (samples, horizon, 1))
        x, y, yaw = (np.full(samples, float(start[i])) for i in (0, 1, 5))
        for k in range(horizon):
            speed, second = controls[:, k, 0], controls[:, k, 1]
            rate = self.yaw_rate_rad_s(speed, second)
            middle = yaw + 0.5 * rate * self.dt_s
            # Exact for an arc: the chord is speed dt sin(h) / h with h = half of the turned angle.
            chord = speed * self.dt_s * np.sinc(0.5 * rate * self.dt_s / np.pi)
            x, y, yaw = x + chord * np.cos(middle), y + chord * np.sin(middle), yaw + rate * self.dt_s
            states[:, k, 0], states[:, k, 1] = x, y
            states[:, k, 5] = np.pi - np.mod(np.pi - yaw, 2.0 * np.pi)
            states[:, k, 6], states[:, k, 7:9] = speed, 0.0
            states[:, k, 9:11], states[:, k, 11] = 0.0, rate
        return states.astype(np.float32)
