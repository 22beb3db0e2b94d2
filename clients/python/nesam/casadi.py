"""The rollout of a session as a CasADi function with Jacobians, for gradient-based planners (IPOPT, acados' external functions, ...).

Jacobians hold the terrain as the rollout met it: on rough ground part of the response comes through ground, context and soil that change with the place, and is
not in them (docs/results/accuracy.md, "Jacobians").

    rollout = nesam.casadi.Rollout("rollout", client, "truck-1", horizon=20)
    u = casadi.MX.sym("u", 2, 20)
    x = rollout(x0, u)                      # (12, 20) from (12,) and (2, 20)
    solver = casadi.nlpsol("plan", "ipopt", {"x": casadi.vec(u), "f": cost(x)}, {"ipopt.hessian_approximation": "limited-memory"})

Needs casadi, which this package does not install.
"""

from typing import Any, Dict, List, Mapping, Optional, Sequence, Union

import casadi
import numpy as np

from ._client import Client
from ._extras import Extras
from ._fallback import KinematicFallback
from ._types import Prediction, Session

_STATE, _COMMAND = 12, 2


class Rollout(casadi.Callback):
    """States (12, horizon) of one candidate from its start (12,) and commands (2, horizon).

    Order of a state: x y z roll pitch yaw vx vy vz wx wy wz; a command is speed m/s and the second command in the unit of the vehicle card; one step is
    0.1 s. use_history, timeout_s, fallback and half are those of `Client.predict`; its other arguments have no place here. The start replaces the newest measured state of the session, whose history and soil are used. Jacobians
    hold the terrain as the rollout met it. Each evaluation asks the service, of the session as it is then. Keep a reference to the object as long as
    functions are made from it, as CasADi asks.

    `eval` raises what `Client.predict` raises. Through a call of the object or of a function that holds it CasADi makes a RuntimeError of that with the same text, and a
    solver that meets it may end without one: look at its `stats()["success"]`. With a `fallback` states come all the same, Jacobians do not. Bound the commands to the range of the vehicle card: beyond it the service refuses.
    """

    def __init__(
        self,
        name: str,
        client: Client,
        session_id: Union[str, Session],
        horizon: int,
        use_history: bool = True,
        timeout_s: Optional[float] = None,
        fallback: Optional[KinematicFallback] = None,
        half: bool = False,
    ):
        casadi.Callback.__init__(self)
        self._client, self._session_id, self.horizon = client, session_id, horizon
        self._options: Dict[str, Any] = {"use_history": use_history, "timeout_s": timeout_s, "fallback": fallback, "half": half}
        self._jacobian: Optional["_Jacobian"] = None
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 2

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return ("x0", "u")[i]

    def get_name_out(self, i: int) -> str:
        return "x"

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        return casadi.Sparsity.dense(*((_STATE, 1), (_COMMAND, self.horizon))[i])

    def get_sparsity_out(self, i: int) -> casadi.Sparsity:
        return casadi.Sparsity.dense(_STATE, self.horizon)

    def eval(self, arguments: Sequence[casadi.DM]) -> List[casadi.DM]:
        """The states."""
        return [casadi.DM(self.predict(arguments[0], arguments[1]).states[0].astype(np.float64).T)]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inames: Sequence[str], onames: Sequence[str], options: Mapping[str, Any]) -> casadi.Function:
        """The Jacobian as a function of start, commands and states."""
        self._jacobian = _Jacobian(name, self, inames, onames, options)
        return self._jacobian

    def predict(self, x0: casadi.DM, u: casadi.DM, extras: Optional[Extras] = None) -> Prediction:
        """What the service predicts from a start (12,) under commands (2, horizon), with these extras."""
        start, controls = np.array(x0).reshape(-1), np.array(u).T[None]
        return self._client.predict(self._session_id, controls, start=start, extras=extras, **self._options)


class _Jacobian(casadi.Callback):
    """Blocks dx/dx0 (12 horizon, 12) and dx/du (12 horizon, 2 horizon), columns stacked as CasADi does."""

    def __init__(self, name: str, rollout: Rollout, inames: Sequence[str], onames: Sequence[str], options: Mapping[str, Any]):
        casadi.Callback.__init__(self)
        self._rollout, self._inames, self._onames = rollout, inames, onames
        self.construct(name, options)

    def get_n_in(self) -> int:
        return 3

    def get_n_out(self) -> int:
        return 2

    def get_name_in(self, i: int) -> str:
        return self._inames[i]

    def get_name_out(self, i: int) -> str:
        return self._onames[i]

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        return self._rollout.get_sparsity_in(i) if i < 2 else casadi.Sparsity(_STATE, self._rollout.horizon)

    def get_sparsity_out(self, i: int) -> casadi.Sparsity:
        horizon = self._rollout.horizon
        return casadi.Sparsity.dense(_STATE * horizon, (_STATE, _COMMAND * horizon)[i])

    def eval(self, arguments: Sequence[casadi.DM]) -> List[casadi.DM]:
        prediction = self._rollout.predict(arguments[0], arguments[1], Extras(jacobians=True))
        if prediction.fallback_reason is not None:
            # A fallback knows no Jacobians: why the service did not tell them is what the caller has to know.
            raise prediction.fallback_reason
        extras = prediction.extras
        assert extras is not None and extras.jacobian_start is not None and extras.jacobian_controls is not None, "asked for; this is a bug"
        rows = _STATE * self._rollout.horizon
        start = extras.jacobian_start[0].reshape(rows, _STATE)
        controls = extras.jacobian_controls[0].reshape(rows, _COMMAND * self._rollout.horizon)
        return [casadi.DM(block.astype(np.float64)) for block in (start, controls)]
