"""Dynamics for pytorch_mppi: one call for the whole horizon instead of one for each step.

    dynamics = nesam.mppi.HorizonDynamics(client, "truck-1")
    planner = pytorch_mppi.MPPI(dynamics, running_cost, nx=12, noise_sigma=..., num_samples=512, horizon=32,
                                step_dependent_dynamics=True, u_min=..., u_max=...)
    dynamics.planner = planner
    command = planner.command(state)

Needs torch and pytorch_mppi, which this package does not install.
"""

from typing import Any, Optional

import numpy as np
import torch

from ._client import Client
from ._types import Prediction


class HorizonDynamics:
    """What pytorch_mppi calls as `dynamics(state, action, t)` with `step_dependent_dynamics=True`.

    At the first step of a cycle the service predicts all steps of all candidates of `planner`; the others are read from its answer. Candidates start from
    the session's newest measured state, or from where `options` say (arguments of `Client.predict`, which may be changed from cycle to cycle:
    `start_stamp_ns` and `sent` ask from now). An action is (speed m/s, second command in the unit of the vehicle card), a state x y z roll pitch yaw vx vy vz
    wx wy wz; one step is 0.1 s. `prediction` is the answer of the cycle, for costs that look at `validity` or `extras`.
    """

    def __init__(self, client: Client, session_id: str, planner: Any = None, **options: Any):
        self.client = client
        self.session_id = session_id
        self.planner = planner
        self.options = options
        self.prediction: Optional[Prediction] = None
        self._actions: Optional[torch.Tensor] = None
        self._states: Optional[torch.Tensor] = None

    def __call__(self, state: torch.Tensor, action: torch.Tensor, t: int) -> torch.Tensor:
        """(rows, 12) states after step `t` of the candidates, whose actions are (rows, 2).

        Raises what `Client.predict` raises; RuntimeError for actions that are not those of the planner's candidates.
        """
        t = int(t)
        if t == 0:
            self._ask(state)
        if self._actions is None or self._states is None:
            raise RuntimeError("HorizonDynamics was asked for a later step before the first one of its cycle")
        rollouts = max(1, len(action) // len(self._actions))
        wanted = self._actions[:, t].repeat(rollouts, 1)
        if wanted.shape != action.shape or not torch.equal(wanted, action.to(wanted.dtype)):
            raise RuntimeError("HorizonDynamics knows the candidates of its planner's cycle only; ask Client.predict for other ones")
        return self._states[:, t].repeat(rollouts, 1)

    def _ask(self, state: torch.Tensor) -> None:
        if self.planner is None:
            raise RuntimeError("set HorizonDynamics.planner to the MPPI that uses it")
        self._actions = self.planner.u_scale * self.planner.perturbed_action
        controls = self._actions.detach().cpu().numpy().astype(np.float32)
        self.prediction = self.client.predict(self.session_id, controls, **self.options)
        expected = (*controls.shape[:2], 12)
        if self.prediction.states.shape != expected or self.options.get("cost") is not None:
            raise ValueError(
                f"options leave states of shape {self.prediction.states.shape}, MPPI needs all of {expected} in the order of its candidates: without cost, "
                "stride, channels, samples_min and other soils"
            )
        self._states = torch.from_numpy(self.prediction.states.copy()).to(state)
