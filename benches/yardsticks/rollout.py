"""The K-step rollout of all candidates, step by step in the order of `nesam`."""

import math
from dataclasses import dataclass
from typing import Callable, Optional

import numpy as np
import torch
from torch import nn

from network import Trunk, soil_from_raw
from physics import StepPhysics, Tilt
from terrain import Ground
from weights import Bundle


@dataclass(frozen=True)
class Scene:
    """What all candidates share. `history`: (T, 12) measured states before the start, oldest first, `commands`: (T, 2) the commands applied from them on,
    `start`: (12,), `soil_delta`: (6,) correction of the soil prior in logarithmic coordinates. All f64 numpy, SI and rad."""

    history: np.ndarray
    commands: np.ndarray
    start: np.ndarray
    soil_delta: np.ndarray


def turned_and_moved(states: np.ndarray) -> np.ndarray:
    """Change of yaw and displacement in the last heading frame (T - 1, 3) between successive states (T, 12)."""
    d = np.diff(states, axis=0)
    sin, cos = np.sin(states[:-1, 5]), np.cos(states[:-1, 5])
    wrapped = np.pi - np.remainder(np.pi - d[:, 5], 2.0 * np.pi)
    return np.stack([wrapped, cos * d[:, 0] + sin * d[:, 1], cos * d[:, 1] - sin * d[:, 0]], axis=1)


class DriveLine(nn.Module):
    """Actuators of a car: steering with lag and rate limit, leaky integral of the speed error. All (N,)."""

    def __init__(self, vehicle: dict, dt_s: float, dtype: torch.dtype):
        super().__init__()
        line, table = vehicle["driveline"], vehicle["steering"]
        self.dt_s = dt_s
        self.travel = line["steering_rate_limit_per_s"] * dt_s
        lag_s = line["steering_lag_s"]
        self.share = 1.0 - math.exp(-dt_s / lag_s) if lag_s > 0.0 else 1.0
        self.leak, self.limit_m = math.exp(-dt_s / line["speed_integral_leak_s"]), line["speed_integral_limit_m"]
        self.gain_per_s = line["speed_integral_gain_per_s"]
        self.register_buffer("position", torch.tensor(table["command"], dtype=dtype))
        rows = [table["front_left_rad"], table["front_right_rad"]]
        self.register_buffer("angle_rad", torch.tensor(rows, dtype=dtype))

    def advance(self, steering, integral_m, speed, second, forward_m_s):
        """Steering and integral after a step under a command."""
        steering = steering + ((second - steering) * self.share).clamp(-self.travel, self.travel)
        integral_m = (integral_m * self.leak + (speed - forward_m_s) * self.dt_s).clamp(-self.limit_m, self.limit_m)
        return steering, integral_m

    def road_wheel_angles(self, steering):
        """Angles (4, N) rad of an actuator position (N,)."""
        steering = steering.clamp(self.position[0], self.position[-1])
        i = (torch.bucketize(steering, self.position, right=True) - 1).clamp(0, len(self.position) - 2)
        share = (steering - self.position[i]) / (self.position[i + 1] - self.position[i])
        low, high = self.angle_rad[:, i], self.angle_rad[:, i + 1]
        front = low + share * (high - low)
        return torch.cat([front, torch.zeros_like(front)])


class Peer(nn.Module):
    """The model in torch; `network` and `motion` may be replaced by compiled forms of themselves."""

    def __init__(self, bundle: Bundle, ground: Ground, dtype: torch.dtype = torch.float32, autocast: bool = False):
        super().__init__()
        scales = bundle.scales
        self.dtype, self.autocast, self.dt_s = dtype, autocast, scales["dt_s"]
        self.ground, self.trunk = ground, Trunk(bundle).to(dtype)
        self.physics = StepPhysics(bundle.vehicle, scales["dt_s"], scales["substeps"], dtype)
        self.line = DriveLine(bundle.vehicle, scales["dt_s"], dtype)
        self.log_ratio_max = scales["sinkage_log_ratio_max"]
        constant = lambda name: self.register_buffer(name, torch.tensor(scales[name], dtype=dtype))
        for name in ("token_mean", "token_scale", "residual_scale"):
            constant(name)
        self.motion: Callable = self.move
        self.network: Callable = self.trunk.forward

    def entries(self, states, turned, moved, commands, floor_m):
        """Scaled token entries (N, 14) of states (12, N), change of yaw (N,), displacement (2, N), commands (2, N) and the height of the ground (N,)."""
        raw = torch.stack([states[2] - floor_m, states[3], states[4], turned, *states[6:], *moved, *commands], dim=1)
        return (raw - self.token_mean) / self.token_scale

    def move(self, states, actuators, commands, said, raw_soil, soil_delta, start):
        """States, actuators and increment after a step. states (12, N): x, y, z from the start, rest absolute; actuators: steering, integral (N,) each."""
        steering, integral_m = actuators
        speed, second = commands
        next_steering, next_integral = self.line.advance(steering, integral_m, speed, second, states[6])
        angle = self.line.road_wheel_angles(0.5 * (steering + next_steering))
        sin, cos = torch.sin(states[5]), torch.cos(states[5])
        offset = Tilt(states[3], states[4]).to_heading(list(self.physics.centre_m))
        x = states[0] + start[0] + cos * offset[0] - sin * offset[1]
        y = states[1] + start[1] + sin * offset[0] + cos * offset[1]
        height, east, north = self.ground(x, y)
        ground = (height - start[2], cos * east + sin * north, cos * north - sin * east)
        sinkage, residual = said
        log_ratio = self.log_ratio_max * torch.tanh(sinkage.T)
        state = torch.cat([states[2:5], states[6:]])
        soil = soil_from_raw(raw_soil, soil_delta)
        increment = self.physics(state, angle, self.line.gain_per_s * integral_m, speed, log_ratio, soil, ground)
        increment = increment + (residual * self.residual_scale).T
        moved = torch.stack([cos * increment[0] - sin * increment[1], sin * increment[0] + cos * increment[1]])
        return states + torch.cat([moved, increment[2:]]), (next_steering, next_integral), increment

    def measured(self, scene: Scene, tokens):
        """Keys and values of the history, and the actuators after it."""
        to = lambda a: torch.tensor(a, dtype=self.dtype)
        states = scene.history
        turned = np.concatenate([[[states[0, 11], states[0, 6], states[0, 7]] * np.array(self.dt_s)], turned_and_moved(states)])
        relative = to(states).T.clone()
        relative[2] = to(states[:, 2] - scene.start[2])
        floor_m = self.ground(to(states[:, 0]), to(states[:, 1]))[0] - scene.start[2]
        entries = self.entries(relative, to(turned[:, 0]), to(turned[:, 1:]).T, to(scene.commands).T, floor_m)
        terrain = tokens.at(0, to(states[:, 0]), to(states[:, 1]), to(states[:, 5]))
        steering, integral_m = to(scene.commands[:1, 1]), to([0.0])
        for state, command in zip(to(states), to(scene.commands)):
            steering, integral_m = self.line.advance(steering, integral_m, command[0], command[1], state[6])
        return self.trunk.prefix(entries, terrain[:, :128]), (steering, integral_m)

    @torch.inference_mode()
    def predict(self, scene: Scene, controls: np.ndarray, tokens, history_tokens=None, steps: Optional[int] = None, kept: Optional[list] = None):
        """States (N, K, 12) of controls (N, K, 2) from the start of a scene, as numpy.

        history_tokens: provider for the history, default `tokens`. steps: stops after so many. kept: takes the tokens of every step.
        """
        samples, horizon = controls.shape[:2]
        horizon = horizon if steps is None else steps
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.autocast):
            prefix, actuators = self.measured(scene, history_tokens or tokens)
            cache = self.trunk.allocate(prefix, samples, controls.shape[1])
        start = torch.tensor(scene.start, dtype=self.dtype)
        delta = torch.tensor(scene.soil_delta, dtype=self.dtype)
        commands = torch.tensor(controls, dtype=self.dtype).permute(1, 2, 0).contiguous()
        relative = scene.start * np.array([0, 0, 0, *[1] * 9])
        states = torch.tensor(relative, dtype=self.dtype)[:, None].expand(12, samples).contiguous()
        last = turned_and_moved(np.stack([scene.history[-1], scene.start]))[0]
        turned, moved = (torch.tensor(part, dtype=self.dtype)[..., None] for part in (last[0], last[1:]))
        turned, moved = turned.expand(samples), moved.expand(2, samples)
        actuators = tuple(a.expand(samples) for a in actuators)
        out = torch.empty(horizon, 12, samples, dtype=self.dtype)
        for k in range(horizon):
            x, y = states[0] + start[0], states[1] + start[1]
            terrain = tokens.at(k, x, y, states[5])
            if kept is not None:
                kept.append(terrain)
            floor_m = self.ground(x, y)[0] - start[2]
            entries = self.entries(states, turned, moved, commands[k], floor_m)
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.autocast):
                said = tuple(part.to(self.dtype) for part in self.network(cache, k, entries, terrain[:, :128]))
            states, actuators, increment = self.motion(states, actuators, commands[k], said, terrain[:, 128:].to(self.dtype), delta, start)
            turned, moved = increment[5], increment[:2]
            out[k] = states
        out[:, :3] += start[:3, None]
        out[:, 5] = math.pi - torch.remainder(math.pi - out[:, 5], 2.0 * math.pi)
        return out.permute(2, 0, 1).contiguous().numpy()
