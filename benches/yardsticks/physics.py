"""One step of the symbolic half, vectorised over samples: terramechanics, wrench, Newton-Euler.

The same equations, constants and order of evaluation as `crates/physics`, for what the shipped car uses: the soil contact law, speed-controlled rims and
no effects. Samples are the last dimension everywhere (N), wheels the one before (4: FL, FR, RL, RR), quadrature nodes the one before that.
"""

import numpy as np
import torch

LATERAL_FLOOR_M_S = 0.02
SLIP_SPEED_FLOOR_M_S = 0.05
SLIDING_FLOOR = 0.02
SHEAR_FLOOR_M = 1e-6
DEPTH_FLOOR_M = 1e-7
RECOVERY = 0.05
NODES = 5


def abs_smooth(x, eps):
    """Smooth |x|."""
    return torch.sqrt(x * x + eps * eps)


def relu_smooth(x, eps=1.0):
    """Smooth max(x, 0)."""
    return 0.5 * (x + torch.sqrt(x * x + 4.0 * eps * eps))


def dot(a, b):
    """a . b of vectors given as three tensors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """a x b of vectors given as three tensors."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def normalise(a):
    """a / |a|."""
    scale = torch.rsqrt(dot(a, a))
    return [c * scale for c in a]


def angle_of_depth(share):
    """Angle (rad), sine and cosine of the rim point at a depth given as share of the radius."""
    cos = 1.0 - share
    sin = torch.sqrt(share * (2.0 - share))
    return 2.0 * torch.atan(sin / (1.0 + cos)), sin, cos


class Tilt:
    """Rotation from Body to the heading frame by roll and pitch, each (N,) rad."""

    def __init__(self, roll, pitch):
        sr, cr, sp, cp = torch.sin(roll), torch.cos(roll), torch.sin(pitch), torch.cos(pitch)
        zero = torch.zeros_like(sr)
        self.rows = [[cp, sp * sr, sp * cr], [zero, cr, -sr], [-sp, cp * sr, cp * cr]]
        self.sr, self.cr, self.cp, self.tan_pitch = sr, cr, cp, sp / cp

    def to_heading(self, v):
        """Body to heading frame."""
        return [dot(row, v) for row in self.rows]

    def to_body(self, v):
        """Heading frame to Body."""
        return [sum(self.rows[r][c] * v[r] for r in range(3)) for c in range(3)]

    def attitude_rates(self, w):
        """Rates of roll, pitch and yaw of an angular velocity in Body."""
        turn = self.sr * w[1] + self.cr * w[2]
        return [w[0] + self.tan_pitch * turn, self.cr * w[1] - self.sr * w[2], turn / self.cp]


class StepPhysics(torch.nn.Module):
    """A vehicle prepared for steps of `dt_s` in `substeps` sub-steps."""

    def __init__(self, vehicle: dict, dt_s: float, substeps: int, dtype: torch.dtype):
        super().__init__()
        self.substeps, self.h = substeps, dt_s / substeps
        self.mass_kg, self.gravity_m_s2 = vehicle["mass_kg"], vehicle["gravity_m_s2"]
        self.inertia = vehicle["inertia_kg_m2"]
        self.radius_m, self.width_m = vehicle["wheel_radius_m"], vehicle["wheel_width_m"]
        line = vehicle["driveline"]
        self.speed_gain, self.overspeed_limit_m_s = line["speed_gain"], line["overspeed_limit_m_s"]
        front, rear = vehicle["wheel_centre_m"][0][0], vehicle["wheel_centre_m"][2][0]
        weight = self.mass_kg * self.gravity_m_s2
        on_front = weight * -rear / (front - rear)
        static = [0.5 * on_front] * 2 + [0.5 * (weight - on_front)] * 2
        x, w = np.polynomial.legendre.leggauss(NODES)
        t = 0.5 * (1.0 - x)
        column = lambda values: torch.tensor(values, dtype=dtype).reshape(-1, 1)
        self.register_buffer("centre_m", torch.tensor(vehicle["wheel_centre_m"], dtype=dtype).T.reshape(3, 4, 1).contiguous())
        self.register_buffer("rate", column(vehicle["suspension_n_m"]))
        self.register_buffer("damper", column(vehicle["suspension_n_s_m"]))
        self.register_buffer("static_n", column(static))
        self.register_buffer("t2", torch.tensor(t * t, dtype=dtype).reshape(-1, 1, 1))
        self.register_buffer("weight", torch.tensor(t * w, dtype=dtype).reshape(-1, 1, 1))

    def forward(self, state, angle, base, speed, log_ratio, soil, ground):
        """Increment (12, N): displacement in the heading frame of the start, attitude, and both velocities in Body.

        state: (9, N) z m (relative to any datum), roll, pitch, v, w. angle: (4, N) rad. base: (N,) integral part of the over-speed, m/s. speed: (N,)
        command, m/s. log_ratio: (4, N). soil: (6, N) k_phi k_c n c phi K. ground: (3, 4, N) height m by the same datum, slope ahead, slope to the left.
        """
        zero = torch.zeros_like(state[0])
        position, attitude = [zero, zero, state[0]], [state[1], state[2], zero]
        v, w = [state[3], state[4], state[5]], [state[6], state[7], state[8]]
        inputs = (torch.sin(angle), torch.cos(angle), base, speed, torch.exp(log_ratio), soil, ground)
        for _ in range(self.substeps):
            position, attitude, v, w = self.substep(position, attitude, v, w, inputs)
        before = [zero, zero, state[0], state[1], state[2], zero, *state[3:]]
        return torch.stack([after - b for after, b in zip([*position, *attitude, *v, *w], before)])

    def substep(self, position, attitude, v, w, inputs):
        """A linearly implicit sub-step: (M + h C + h^2 K) dv = h (f - h K v)."""
        h, tilt = self.h, Tilt(attitude[0], attitude[1])
        gravity = tilt.to_body([0.0, 0.0, -self.gravity_m_s2])
        turning, momentum = cross(w, v), [sum(self.inertia[r][c] * w[c] for c in range(3)) for r in range(3)]
        force = [self.mass_kg * (g - t) for g, t in zip(gravity, turning)]
        torque = [-t for t in cross(w, momentum)]
        g, push, damping = self.contacts(position, v, w, tilt, inputs)
        rhs = torch.stack([*force, *torque]) + (g * push).sum(1)
        pressed = g * (damping * h)
        lhs = [list((pressed[r] * g[: r + 1]).sum(1)) for r in range(6)]
        for r in range(3):
            lhs[r][r] = lhs[r][r] + self.mass_kg
            for c in range(r + 1):
                lhs[r + 3][c + 3] = lhs[r + 3][c + 3] + self.inertia[r][c]
        delta = solve_spd(lhs, list(rhs * h))

        dv, dw = delta[:3], delta[3:]
        rates = tilt.attitude_rates([a + 0.5 * d for a, d in zip(w, dw)])
        yaw = attitude[2] + rates[2] * (0.5 * h)
        sin, cos = torch.sin(yaw), torch.cos(yaw)
        ahead, left, up = tilt.to_heading([h * (a + 0.5 * d) for a, d in zip(v, dv)])
        position = [position[0] + cos * ahead - sin * left, position[1] + sin * ahead + cos * left, position[2] + up]
        attitude = [a + h * r for a, r in zip(attitude, rates)]
        return position, attitude, [a + d for a, d in zip(v, dv)], [a + d for a, d in zip(w, dw)]

    def contacts(self, position, v, w, tilt, inputs):
        """Contact axes as generalised directions G (6, 12, N), forces along them (12, N) less their stiff part, and damping (12, N), axes before wheels."""
        sin, cos, base, speed, ratio, soil, (height, slope_ahead, slope_left) = inputs
        centre = [c.expand_as(height) for c in self.centre_m]
        velocity = [a + b for a, b in zip(v, cross(w, centre))]
        normal = tilt.to_body(normalise([-slope_ahead, -slope_left, torch.ones_like(slope_left)]))
        along = cos * normal[0] + sin * normal[1]
        forward = normalise([cos - along * normal[0], sin - along * normal[1], -along * normal[2]])
        left = cross(normal, forward)

        ground = height + slope_ahead * position[0] + slope_left * position[1]
        distance = (position[2] + tilt.to_heading(centre)[2] - ground) / torch.sqrt(1.0 + slope_ahead**2 + slope_left**2)
        forward_m_s, left_m_s = dot(velocity, forward), dot(velocity, left)
        preload = self.static_n + self.rate * (self.radius_m - distance) - self.damper * dot(velocity, normal)
        demand = base + self.speed_gain * (speed - v[0])
        over_m_s = demand / torch.sqrt(1.0 + (demand / self.overspeed_limit_m_s) ** 2)
        direction, motion = self.contact_motion(forward_m_s + over_m_s, forward_m_s, left_m_s)
        balanced = self.balance(preload, self.rate * ratio, soil)
        sinkage = balanced * ratio
        load = relu_smooth(preload - self.rate * sinkage)
        thrust, side, carried = self.wrench(sinkage, motion, soil)
        share = load / relu_smooth(carried)
        soil_rate = (soil[2] + 0.5) * load / balanced
        in_series = soil_rate / (soil_rate + self.rate)
        thrust, side = thrust * share, side * share
        # Secant slopes bound the tangents of the concave shear law, so the implicit step never under-damps.
        drag = abs_smooth(thrust, 1.0) / abs_smooth(over_m_s.expand_as(thrust), LATERAL_FLOOR_M_S) * self.speed_gain
        sway = abs_smooth(side, 1.0) / abs_smooth(left_m_s, LATERAL_FLOOR_M_S)
        stiffness = self.rate * in_series

        lever = [c - distance * n for c, n in zip(centre, normal)]
        axes = [[*e, *cross(lever, e)] for e in (forward, left, normal)]
        closing = dot(normal, v) + dot(axes[2][3:], w)
        g = torch.stack([torch.cat([axis[r] for axis in axes]) for r in range(6)])
        push = torch.cat([thrust * direction, side, load - self.h * stiffness * closing])
        return g, push, torch.cat([drag, sway, self.damper * in_series + self.h * stiffness])

    @staticmethod
    def contact_motion(rim, forward, left):
        """Rolling direction, and speeds as ratios to the rim: travel, rim, lateral; each (4, N)."""
        total = rim + forward
        direction = total / abs_smooth(total, SLIP_SPEED_FLOOR_M_S)
        rim = direction * rim
        scale = 1.0 / abs_smooth(rim, SLIP_SPEED_FLOOR_M_S)
        return direction, (direction * forward * scale, rim * scale, left * scale)

    def balance(self, preload, rate, soil):
        """Sinkage (4, N) m at which the soil carries what the suspension presses into it."""
        n, load = soil[2], preload.clamp(min=1.0)
        stiffness = (3.0 - n) * (soil[1] + soil[0] * self.width_m) * (2.0 * self.radius_m) ** 0.5
        z = torch.exp(torch.log(3.0 * load / stiffness) * (2.0 / (2.0 * n + 1.0)))
        z = z * load / (load + rate * z)
        for _ in range(3):
            carried, _ = self.carried(z, soil, slope=False)
            z = self.bounded(z, z - (carried - relu_smooth(preload - rate * z)) / ((n + 0.5) * carried / z + rate))
        carried, slope = self.carried(z, soil, slope=True)
        free = preload - rate * z
        rises = slope + 0.5 * rate * (1.0 + free / torch.sqrt(free * free + 4.0))
        return self.bounded(z, z - (carried - relu_smooth(free)) / rises)

    def bounded(self, z, following):
        """Keeps a step within a decade and the wheel."""
        return torch.minimum(torch.maximum(following, 0.1 * z), 4.0 * z).clamp(max=0.85 * self.radius_m).clamp(min=1e-5)

    def arc(self, z, soil):
        """Contact arc at a sinkage (4, N): entry angle, its sine, rear angle, its sine; front angles (5, 4, N), their cosines and pressures Pa."""
        share = z.clamp(1e-5, 0.9 * self.radius_m) / self.radius_m
        entry, sin_entry, cos_entry = angle_of_depth(share)
        rear, sin_rear, _ = angle_of_depth(share * RECOVERY + 1e-24)
        front = entry * (1.0 - self.t2)
        cos_front = torch.cos(front)
        depth = ((cos_front - cos_entry) * self.radius_m).clamp(min=DEPTH_FLOOR_M)
        pressure = (soil[1] / self.width_m + soil[0]) * torch.exp(torch.log(depth) * soil[2])
        return (entry, sin_entry, rear, sin_rear), (front, cos_front, depth, pressure)

    def carried(self, z, soil, slope):
        """Load W(z) (4, N) N and, when asked for, dW/dz N/m. Under this law shear carries no load."""
        (entry, sin_entry, rear, sin_rear), (front, cos_front, depth, pressure) = self.arc(z, soil)
        back = rear * (1.0 - self.t2)
        cos_back = torch.cos(back)
        area = self.radius_m * self.width_m
        spread = entry * cos_front + rear * cos_back
        load = area * (self.weight * pressure * spread).sum(0)
        if not slope:
            return load, None
        d_entry, d_rear = 1.0 / (self.radius_m * sin_entry), RECOVERY / (self.radius_m * sin_rear)
        sin_front, sin_back = torch.sin(front), torch.sin(back)
        d_front, d_back = (1.0 - self.t2) * d_entry, (1.0 - self.t2) * d_rear
        d_depth = self.radius_m * (sin_entry * d_entry - sin_front * d_front)
        d_spread = d_entry * cos_front - entry * sin_front * d_front + d_rear * cos_back - rear * sin_back * d_back
        return load, area * (self.weight * pressure * (soil[2] * d_depth / depth * spread + d_spread)).sum(0)

    def wrench(self, z, motion, soil):
        """Thrust, side force and load (4, N) N of the stresses over the contact at a sinkage."""
        (entry, sin_entry, rear, _), (front, cos_front, _, pressure) = self.arc(z, soil)
        strength = soil[3] + pressure * torch.tan(soil[4])
        back = -rear * (1.0 - self.t2)
        sums = [0.0, 0.0, 0.0]
        travel, rim, lateral = motion
        for theta, cos, length in ((front, cos_front, entry), (back, torch.cos(back), rear)):
            swept = entry - theta
            j_x = (rim * (sin_entry - torch.sin(theta)) - travel * swept) * self.radius_m
            j_y = lateral * swept * self.radius_m
            j = torch.sqrt(j_x * j_x + j_y * j_y + SHEAR_FLOOR_M**2)
            u_x = rim * cos - travel
            mobilised = strength * (1.0 - torch.exp(-j / soil[5])) / torch.sqrt(u_x * u_x + lateral * lateral + SLIDING_FLOOR**2)
            across = self.weight * length * cos
            parts = (mobilised * u_x, -mobilised * lateral, pressure)
            sums = [total + (part * across).sum(0) for total, part in zip(sums, parts)]
        area = self.radius_m * self.width_m
        return [area * total for total in sums]


def solve_spd(a, b):
    """Solves a symmetric positive definite system of six for every sample by Cholesky. a: rows of the lower triangle, b: six tensors (N,)."""
    a = [list(row) for row in a]
    for j in range(6):
        for k in range(j):
            a[j][j] = a[j][j] - a[j][k] * a[j][k]
        a[j][j] = torch.sqrt(a[j][j])
        inverse = 1.0 / a[j][j]
        for i in range(j + 1, 6):
            for k in range(j):
                a[i][j] = a[i][j] - a[i][k] * a[j][k]
            a[i][j] = a[i][j] * inverse
    for i in range(6):
        for k in range(i):
            b[i] = b[i] - a[i][k] * b[k]
        b[i] = b[i] / a[i][i]
    for i in reversed(range(6)):
        for k in range(i + 1, 6):
            b[i] = b[i] - a[k][i] * b[k]
        b[i] = b[i] / a[i][i]
    return b
