"""Goal: planners of other people run on the service without loops of their own. Method: pytorch_mppi and CasADi as they are, and a real server; skipped where
they are not installed."""

import numpy as np
import pytest

import nesam
from test_client import fan


def test_service_casadi_has_the_jacobians_of_the_service(driven):
    casadi = pytest.importorskip("casadi")
    from nesam.casadi import Rollout

    horizon = 8
    rollout = Rollout("rollout", driven, "truck", horizon)
    start = driven.session("truck").state
    controls = fan(1, horizon)[0] + np.linspace(0, 0.2, horizon)[:, None].astype(np.float32)
    x0, u = casadi.MX.sym("x0", 12), casadi.MX.sym("u", 2, horizon)
    x = rollout(x0, u)
    outputs = [x, casadi.jacobian(casadi.vec(x), x0), casadi.jacobian(casadi.vec(x), casadi.vec(u))]
    states, by_start, by_controls = (np.array(v) for v in casadi.Function("f", [x0, u], outputs)(start, controls.T))
    full = driven.predict("truck", controls[None], start=start, extras=nesam.Extras(jacobians=True))
    np.testing.assert_array_equal(states, full.states[0].T)
    np.testing.assert_array_equal(by_start, full.extras.jacobian_start[0].reshape(12 * horizon, 12))
    np.testing.assert_array_equal(by_controls, full.extras.jacobian_controls[0].reshape(12 * horizon, 2 * horizon))
    # Columns are stacked step by step on both sides: the last speed command moves no state but the last one.
    last = by_controls[:, -2].reshape(horizon, 12)
    assert (last[:-1] == 0).all() and (last[-1] != 0).any()


def test_service_casadi_answers_from_the_session_as_it_is(driven):
    casadi = pytest.importorskip("casadi")
    from nesam.casadi import Rollout

    horizon = 8
    start, controls = driven.session("truck").state, fan(1, horizon)[0]
    rollout = Rollout("rollout", driven, "truck", horizon)
    u = casadi.MX.sym("u", 2, horizon)
    x = rollout(start, u)
    function = casadi.Function("f", [u], [x, casadi.jacobian(casadi.vec(x), casadi.vec(u))])
    before = [np.array(value) for value in function(controls.T)]
    driven.apply_effects("truck", [nesam.Effect("speed_gain", {"relative": 0.1})])
    after = [np.array(value) for value in function(controls.T)]
    full = driven.predict("truck", controls[None], start=start, extras=nesam.Extras(jacobians=True))
    np.testing.assert_array_equal(after[0], full.states[0].T)
    np.testing.assert_array_equal(after[1], full.extras.jacobian_controls[0].reshape(12 * horizon, 2 * horizon))
    assert (after[0] != before[0]).any() and (after[1] != before[1]).any()


def test_regress_casadi_says_why_a_fallback_has_no_jacobians():
    casadi = pytest.importorskip("casadi")
    from nesam.casadi import Rollout

    card = nesam.VehicleCard("cart", "yaw_rate_rad_s", (-1.0, 3.0), (-1.0, 1.0), 1.0, 0.0)
    with nesam.Client("127.0.0.1:1", timeout_s=0.5) as away:
        rollout = Rollout("rollout", away, "s", 3, fallback=nesam.KinematicFallback(card))
        start, controls = casadi.DM.zeros(12), casadi.DM([[1.0] * 3, [0.0] * 3])
        states = np.array(rollout(start, controls))
        np.testing.assert_allclose(states[0], [0.1, 0.2, 0.3], rtol=1e-6)
        jacobian = rollout.get_jacobian("jacobian", ["x0", "u", "out_x"], ["jac_x_x0", "jac_x_u"], {})
        with pytest.raises((nesam.Unavailable, nesam.DeadlineExceeded)):
            jacobian.eval([start, controls, states])


def test_service_a_gradient_planner_drives_to_its_goal(driven):
    casadi = pytest.importorskip("casadi")
    from nesam.casadi import Rollout

    horizon = 12
    session = driven.session("truck")
    start, card = session.state, session.vehicle
    rollout = Rollout("rollout", driven, "truck", horizon)
    u = casadi.MX.sym("u", 2, horizon)
    # Where the vehicle would get with its speed and a steady left turn.
    turn = np.tile(np.float32([2.0, 0.4]), (1, horizon, 1))
    goal = driven.predict("truck", turn, start=start).states[0, -1, :2].astype(float)
    miss = rollout(start, u)[:2, -1] - goal
    effort = casadi.sumsqr(u[1, :]) * 1e-4
    bounds = [(card.speed_range_m_s[i], card.second_range[i]) * horizon for i in (0, 1)]
    options = {"ipopt.hessian_approximation": "limited-memory", "ipopt.max_iter": 15, "ipopt.print_level": 0, "print_time": False}
    solver = casadi.nlpsol("plan", "ipopt", {"x": casadi.vec(u), "f": casadi.sumsqr(miss) + effort}, options)
    straight = np.tile([2.0, 0.0], horizon)
    found = np.array(solver(x0=straight, lbx=bounds[0], ubx=bounds[1])["x"]).reshape(horizon, 2)

    def distance(controls):
        end = driven.predict("truck", np.asarray(controls).reshape(1, horizon, 2), start=start).states[0, -1, :2]
        return np.hypot(*(end - goal))

    assert distance(straight) > 0.1 and distance(found) < 0.25 * distance(straight)


def test_service_pytorch_mppi_asks_once_a_cycle(driven):
    torch = pytest.importorskip("torch")
    pytorch_mppi = pytest.importorskip("pytorch_mppi")
    from nesam.mppi import HorizonDynamics

    samples, horizon = 64, 16
    start = torch.tensor(driven.session("truck").state)
    ahead = start[:2] + torch.tensor([4.0, 1.0], dtype=start.dtype)

    def running_cost(state, action, t):
        return ((state[:, :2] - ahead) ** 2).sum(dim=1)

    dynamics = HorizonDynamics(driven, "truck")
    planner = pytorch_mppi.MPPI(
        dynamics,
        running_cost,
        nx=12,
        noise_sigma=torch.diag(torch.tensor([0.1, 0.05], dtype=start.dtype)),
        num_samples=samples,
        horizon=horizon,
        lambda_=0.05,
        u_min=torch.tensor([0.5, -1.0], dtype=start.dtype),
        u_max=torch.tensor([3.0, 1.0], dtype=start.dtype),
        U_init=torch.tensor([[2.0, 0.0]], dtype=start.dtype).repeat(horizon, 1),
        step_dependent_dynamics=True,
    )
    dynamics.planner = planner
    asked = []
    predict = driven.predict
    driven.predict = lambda *arguments, **options: asked.append(1) or predict(*arguments, **options)
    try:
        for _ in range(8):
            command = planner.command(start, shift_nominal_trajectory=False)
    finally:
        del driven.predict
    assert len(asked) == 8 and dynamics.prediction.states.shape == (samples, horizon, 12)
    assert command.shape == (2,) and command[1] > 0.02, "the goal lies to the left"
    with pytest.raises(RuntimeError, match="candidates of its planner"):
        dynamics(start[None], torch.zeros(1, 2, dtype=start.dtype), 1)


def test_property_casadi_says_at_once_what_it_cannot_take():
    casadi = pytest.importorskip("casadi")
    from nesam.casadi import Rollout

    no = {"extras": nesam.Extras(risk=True), "start": casadi.DM.zeros(12), "stride": 2, "channels": ["x"], "start_stamp_ns": 5, "sent": [], "samples_min": 1}
    no["cost"] = nesam.PathCost(np.zeros((2, 2)), 1.0)
    with nesam.Client("127.0.0.1:9") as client:
        for name, value in no.items():
            with pytest.raises(TypeError, match=f"'{name}'"):
                Rollout("rollout", client, "s", 3, **{name: value})
