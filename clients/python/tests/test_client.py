"""Goal: what the service says reaches numpy unchanged, and what it refuses becomes a typed error. Method: a real server."""

import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import grpc
import numpy as np
import pytest

import nesam
from conftest import straight
from nesam._fallback import KnownState
from nesam.v1 import prediction_pb2


def fan(samples, horizon, speed=2.0):
    """Controls (samples, horizon, 2): the same speed, steering from right to left."""
    controls = np.empty((samples, horizon, 2), dtype=np.float32)
    controls[..., 0] = speed
    controls[..., 1] = np.linspace(-0.5, 0.5, samples)[:, None]
    return controls


def test_service_prediction_shapes_and_provenance(driven):
    prediction = driven.predict("truck", fan(5, 32), wheel_sinkage=True)
    assert prediction.states.shape == (5, 32, 12) and prediction.states.dtype == np.float32
    assert prediction.sinkage_m.shape == (5, 32, 4)
    assert prediction.validity.shape == (5,) and prediction.soil.shape == (6,)
    assert np.isfinite(prediction.states).all()
    assert prediction.history_steps == 31 and prediction.computed_by == "service"
    assert prediction.provenance.history_epoch == 40 and prediction.provenance.map_id == "hills"
    assert len(prediction.provenance.bundle_hash) == 64
    assert prediction.start[0] == pytest.approx(-2.2) and 0 <= prediction.measurement_age_s < 60
    np.testing.assert_allclose(prediction.steps_s[[0, -1]], [0.1, 3.2])


def test_service_prediction_is_repeatable_and_rows_are_independent(driven):
    batch = driven.predict("truck", fan(17, 10)).states
    assert (driven.predict("truck", fan(17, 10)).states == batch).all()
    for n in (0, 8, 16):
        assert (driven.predict("truck", fan(17, 10)[n : n + 1]).states[0] == batch[n]).all()


def test_service_selection_returns_the_slice(driven):
    whole = driven.predict("truck", fan(3, 9))
    part = driven.predict("truck", fan(3, 9), channels=("yaw", "x"), stride=4)
    assert part.channels == ("x", "yaw") and part.states.shape == (3, 2, 2)
    assert (part.states == whole.states[:, [3, 7]][:, :, [0, 5]]).all()
    np.testing.assert_allclose(part.steps_s, [0.4, 0.8])


def test_service_the_best_of_what_the_service_draws(driven):
    drawing = nesam.Drawing(fan(1, 12)[0], samples=16, sd=(0.5, 0.2), correlation=0.8, seed=3)
    everything = driven.predict("truck", drawing)
    assert everything.controls.shape == (16, 12, 2) and (everything.controls[0] == drawing.nominal).all()
    assert (driven.predict("truck", everything.controls).states == everything.states).all()
    path = everything.start[:2] + np.outer(np.linspace(-5, 30, 36), [np.cos(everything.start[5]), np.sin(everything.start[5])])
    ranked = driven.predict("truck", drawing, cost=nesam.PathCost(path, 2.0, best=3, temperature=0.1), channels=("x", "y"))
    assert ranked.states.shape == (3, 12, 2) and ranked.ranking.costs.shape == (16,) and ranked.ranking.mean_controls.shape == (12, 2)
    assert (ranked.ranking.best == np.argsort(ranked.ranking.costs, kind="stable")[:3]).all()
    assert (ranked.states == everything.states[ranked.ranking.best][:, :, :2]).all()
    assert (ranked.controls == everything.controls[ranked.ranking.best]).all()
    assert everything.ranking is None and driven.predict("truck", fan(1, 1)).controls is None
    with pytest.raises(nesam.InvalidArgument) as refused:
        driven.predict("truck", drawing, cost=nesam.PathCost(path, 2.0, best=17))
    assert refused.value.field == "cost.best"
    with pytest.raises(ValueError, match="path"):
        driven.predict("truck", drawing, cost=nesam.PathCost(np.zeros(4), 2.0))


def test_service_half_precision_is_rounding_only(driven):
    whole = driven.predict("truck", fan(3, 32), wheel_sinkage=True)
    half = driven.predict("truck", fan(3, 32), wheel_sinkage=True, half=True)
    assert half.states.dtype == np.float32 and half.states.shape == whole.states.shape
    # Eleven significant bits: 2^-11 of the number, of the offset from the start for positions (within 8 m here, so half of 2^-8 m).
    np.testing.assert_allclose(half.states[..., :3], whole.states[..., :3], rtol=0, atol=2**-9 * 1.01)
    np.testing.assert_allclose(half.states[..., 3:], whole.states[..., 3:], rtol=2**-10, atol=1e-6)
    np.testing.assert_allclose(half.sinkage_m, whole.sinkage_m, rtol=2**-10, atol=1e-6)


def test_service_prediction_from_now_rolls_forward_with_what_was_sent(driven):
    step_ns, newest_ns = 100_000_000, 39 * 100_000_000
    sent = [(newest_ns + i * step_ns, (2.0, 0.05 * i)) for i in range(1, 4)]
    # The newest measurement says (2.0, 0.0) until the first sent command takes over.
    before = np.array([[2.0, 0.0], *(command for _, command in sent)], dtype=np.float32)
    now = driven.predict("truck", fan(3, 5), start_stamp_ns=newest_ns + 4 * step_ns, sent=sent)
    controls = np.concatenate([np.repeat(before[None], 3, axis=0), fan(3, 5)], axis=1)
    by_hand = driven.predict("truck", controls)
    assert (now.states == by_hand.states[:, 4:]).all()
    assert (now.rolled_forward_steps, now.start_stamp_ns) == (4, newest_ns + 4 * step_ns)
    np.testing.assert_array_equal(now.start, by_hand.states[0, 3].astype(np.float64))
    with pytest.raises(nesam.FailedPrecondition) as caught:
        driven.predict("truck", fan(3, 30), start_stamp_ns=newest_ns + 4 * step_ns)
    assert caught.value.field == "start_stamp_ns" and "2" in caught.value.message


def test_service_extras_have_shapes_and_agree_with_each_other(driven):
    plain = driven.predict("truck", fan(2, 6))
    asked = nesam.Extras(jacobians=True, risk=True)
    full = driven.predict("truck", fan(2, 6), extras=asked, stride=2)
    assert (full.states == plain.states[:, 1::2]).all() and plain.extras is None
    extras = full.extras
    assert extras.jacobian_start.shape == (2, 3, 12, 12) and extras.jacobian_soil.shape == (2, 3, 12, 6)
    assert extras.jacobian_controls.shape == (2, 3, 12, 6, 2) and extras.covariance is None
    # The second step does not know the third command; the state moves with its start.
    assert (extras.jacobian_controls[:, 0, :, 2:] == 0).all() and (extras.jacobian_controls[:, 2, 0, 0] != 0).any()
    # A start further ahead is an end further ahead; not one to one, as the network sees how far the vehicle has come since the last measurement.
    np.testing.assert_allclose(extras.jacobian_start[:, :, 0, 0], 1.0, atol=0.3)
    assert extras.wheel_load_n.shape == extras.wheel_slip.shape == (2, 3, 4)
    # A 2.5-tonne car that was set down on gentle hills, some of its wheels below the ground: it carries its weight once its springs have settled.
    np.testing.assert_allclose(extras.wheel_load_n[:, 1:].sum(axis=-1), 24_460, rtol=0.1)
    assert ((extras.load_transfer_ratio >= 0) & (extras.load_transfer_ratio <= 1)).all() and extras.traction_reserve.shape == (2, 3)
    assert extras.interpolation_deviation_m is None
    moved = driven.predict("truck", fan(2, 6), extras=nesam.Extras(interpolation_deviation=True)).extras.interpolation_deviation_m
    assert 0 < moved < 0.05


def test_service_what_if_soils_are_groups(driven):
    plain = driven.predict("truck", fan(3, 8))
    deltas = np.zeros((2, 6))
    deltas[1, 3] = -1.0
    soils = driven.predict("truck", fan(3, 8), extras=nesam.Extras(soil_deltas=deltas))
    assert soils.states.shape == (2, 3, 8, 12) and soils.validity.shape == (2, 3)
    assert (soils.states[0] == plain.states).all() and (soils.states[1] != plain.states).any()
    sigma = driven.predict("truck", fan(3, 8), extras=nesam.Extras(soil_sigma_points=True, risk=True))
    assert sigma.states.shape == (13, 3, 8, 12) and sigma.extras.traction_reserve.shape == (13, 3, 8)
    assert (sigma.states[0] == plain.states).all()
    with pytest.raises(ValueError, match="soil_deltas"):
        driven.predict("truck", fan(1, 1), extras=nesam.Extras(soil_deltas=np.zeros(6)))
    with pytest.raises(nesam.InvalidArgument) as caught:
        driven.predict("truck", fan(9, 1), extras=nesam.Extras(jacobians=True))
    assert caught.value.field == "extras.jacobians"


def test_service_covariance_grows_and_is_symmetric(driven):
    prediction = driven.predict("truck", fan(2, 32), extras=nesam.Extras(covariance=True))
    covariance = prediction.extras.covariance.astype(np.float64)
    assert covariance.shape == (2, 32, 12, 12) and prediction.extras.region_90_single.shape == (6,)
    np.testing.assert_array_equal(covariance, np.swapaxes(covariance, 2, 3))
    size = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    correlation = covariance / (size[..., :, None] * size[..., None, :])
    assert np.linalg.eigvalsh(correlation).min() > -1e-5
    assert (size[:, 31, :2] > size[:, 7, :2]).all() and prediction.extras.region_90_planar > 0


def test_service_soil_is_in_every_reply(driven):
    answer = driven.measure(list(straight("truck", 41))[40:])[0]
    session, prediction = driven.session("truck"), driven.predict("truck", fan(1, 1))
    for soil in (answer.soil, session.soil, prediction.soil_correction):
        assert soil.coordinates == "logarithmic" and soil.learned.dtype == bool
        assert (soil.delta == session.soil.delta).all() and (soil.covariance == session.soil.covariance).all()
    assert (np.linalg.eigvalsh(session.soil.covariance) > 0).all()
    named = (answer.history_epoch, answer.soil_epoch, answer.map_version, answer.bundle_hash)
    provenance = session.provenance
    assert named == (provenance.history_epoch, provenance.soil_epoch, provenance.map_version, provenance.bundle_hash)


def test_validity_names_every_bit_of_the_service():
    bits = {name[len("VALIDITY_") :]: value for name, value in prediction_pb2.Validity.items() if value}
    assert bits == {bit.name: bit.value for bit in nesam.Validity}


def test_service_forked_session_goes_its_own_way(driven):
    copy = driven.fork_session("truck", "what-if")
    assert copy.provenance == driven.session("truck").provenance and copy.vehicle_id == "truck"
    assert (driven.predict("what-if", fan(2, 4)).states == driven.predict("truck", fan(2, 4)).states).all()
    driven.measure(list(straight("what-if", 41))[40:])
    assert driven.session("what-if").provenance.history_epoch == 41 and driven.session("truck").provenance.history_epoch == 40
    with pytest.raises(nesam.AlreadyExists) as caught:
        driven.fork_session("truck", "what-if")
    assert caught.value.field == "new_session_id"


def test_service_effects_are_told_as_they_were_sent(driven):
    effects = (nesam.Effect("steering_offset", {"second": 0.08}, {"second": 0.01}), nesam.Effect("speed_gain", {"relative": 0.1}))
    applied = driven.apply_effects("truck", effects, source="a test")
    assert (applied.effects, applied.effects_source) == (effects, "a test")
    assert driven.session("truck").effects == effects and [s.effects for s in driven.sessions()] == [effects]
    assert driven.fork_session("truck", "copy").effects == effects
    assert driven.import_session(driven.export_session("truck"), "again").effects == effects
    assert driven.revert_effects("truck").effects == driven.session("truck").effects == ()


def test_service_measurement_answers_are_typed(driven):
    with driven.measurement_stream() as stream:
        again = list(straight("truck", 42))
        assert stream.send(again[39]).outcome == "DUPLICATE"
        assert stream.send(again[40]).outcome in ("APPLIED", "GATED")
        late = nesam.Measurement("truck", 150_000_000, again[0].state, (1.0, 0.0))
        assert stream.send(late).outcome == "TOO_OLD"
        bad = np.zeros(12)
        bad[7] = np.nan
        answer = stream.send(nesam.Measurement("truck", 41 * 100_000_000, bad, (1.0, 0.0)))
        assert (answer.outcome, answer.field) == ("NOT_FINITE", "state.velocity_m_s.y")
        answer = stream.send(nesam.Measurement("nobody", 0, np.zeros(12), (1.0, 0.0)))
        assert (answer.outcome, answer.field) == ("REJECTED", "session_id") and "nobody" in answer.message
        wheels = nesam.Measurement("truck", 41 * 100_000_000, again[41].state, (2.0, 0.0), 42, [4.0] * 4, [0.0] * 2)
        assert stream.send(wheels).outcome == "APPLIED"
        assert stream.send(nesam.Measurement("truck", 99 * 100_000_000, again[41].state, (2.0, 0.0))).outcome == "GAP"
    session = driven.session("truck")
    assert (session.history_steps, session.last_sequence, session.last_stamp_ns) == (1, 42, 99 * 100_000_000)


@pytest.mark.parametrize(
    "change, error, field",
    [
        ({"session_id": "nobody"}, nesam.NotFound, "session_id"),
        ({"controls": fan(2, 33)}, nesam.InvalidArgument, "horizon"),
        ({"controls": fan(4097, 1)}, nesam.InvalidArgument, "samples"),
        ({"controls": fan(0, 3)}, nesam.InvalidArgument, "samples"),
        ({"controls": fan(4, 3), "samples_min": 5}, nesam.InvalidArgument, "samples_min"),
        ({"controls": fan(2, 3) * np.float32(np.nan)}, nesam.InvalidArgument, "controls[0, 0]"),
        ({"controls": fan(2, 3, speed=500.0)}, nesam.InvalidArgument, "controls[0, 0].speed_m_s"),
        ({"start": np.full(12, np.inf)}, nesam.InvalidArgument, "start.position_m.x"),
        ({"start": [500.0] + [0.0] * 11}, nesam.InvalidArgument, "start.position_m"),
        ({"stride": 4}, nesam.InvalidArgument, "output.stride"),
    ],
)
def test_service_refusals_name_the_field(driven, change, error, field):
    before = driven.session("truck")
    with pytest.raises(error) as caught:
        driven.predict(**{"session_id": "truck", "controls": fan(2, 3), **change})
    assert caught.value.field == field and len(caught.value.message) > 10
    after = driven.session("truck")
    assert after.provenance == before.provenance and (after.state == before.state).all()


def test_wrong_shapes_are_refused_before_anything_is_sent(driven):
    for controls in (np.zeros((3, 2)), np.zeros((2, 3, 3))):
        with pytest.raises(ValueError, match="samples, horizon, 2"):
            driven.predict("truck", controls)
    with pytest.raises(ValueError, match="start"):
        driven.predict("truck", fan(1, 1), start=np.zeros(6))
    with pytest.raises(ValueError, match="channels"):
        driven.predict("truck", fan(1, 1), channels=("speed",))
    with pytest.raises(ValueError, match="semantic_rgb"):
        driven.upload_map(nesam.WorldMap("m", np.zeros((4, 4)), 0.5, semantic_rgb=np.zeros((4, 3, 3))))


def test_service_a_measurement_for_another_run_is_rejected(driven):
    first, *_, last = straight("truck", 42)
    run = driven.measure([first])[0].run
    assert run and driven.session("truck").run == run
    [applied] = driven.measure([replace(list(straight("truck", 41))[-1], run=run)])
    assert applied.outcome in ("APPLIED", "GATED")
    [rejected] = driven.measure([replace(last, run=run ^ 1)])
    assert (rejected.outcome, rejected.field, rejected.code) == ("REJECTED", "run", grpc.StatusCode.FAILED_PRECONDITION.value[0])
    assert driven.session("truck").last_sequence == 41


def test_service_sessions_and_maps(client, hills):
    description = client.upload_map(hills)
    assert (description.width, description.height, description.version, description.semantic) == (161, 121, 1, True)
    with pytest.raises(nesam.AlreadyExists):
        client.upload_map(hills)
    session = client.open_session("truck", session_id="s", map_id="hills")
    assert session.state is None and session.last_stamp_ns is None and session.history_steps == 0
    assert session.vehicle.speed_range_m_s[1] > 0 and session.vehicle.wheelbase_m > 0
    with pytest.raises(nesam.FailedPrecondition) as caught:
        client.predict("s", fan(1, 1))
    assert caught.value.field == "start"
    with pytest.raises(nesam.FailedPrecondition):
        client.delete_map("hills")
    patched = client.patch_tile("hills", 1, 10, 20, np.full((5, 6), 0.1))
    assert patched.version == 2 and patched.hash != description.hash
    with pytest.raises(nesam.NesamError, match="ABORTED"):
        client.patch_tile("hills", 1, 10, 20, np.full((5, 6), 0.1))
    local = client.upload_map(nesam.WorldMap("local", np.zeros((4, 4)), 0.5, stamp_ns=-5, frame="odom"))
    assert (local.stamp_ns, local.frame, description.stamp_ns, description.frame) == (-5, "odom", None, "")
    client.delete_map("local")
    assert [m.map_id for m in client.maps()] == ["hills"] and client.map("hills") == patched
    client.close_session("s")
    with pytest.raises(nesam.NotFound):
        client.session("s")


def test_service_fallback_is_declared(driven):
    fallback = nesam.KinematicFallback(driven.session("truck").vehicle)
    # While the one before is still being given up, the service says at once that there is no time.
    too_late = (nesam.DeadlineExceeded, nesam.Overloaded)
    with pytest.raises(too_late):
        driven.predict("truck", fan(2000, 32), timeout_s=0.004)
    late = driven.predict("truck", fan(2000, 32), timeout_s=0.004, fallback=fallback, channels=("x", "y"), stride=8)
    assert late.computed_by == "kinematic_fallback" and isinstance(late.fallback_reason, too_late)
    assert late.states.shape == (2000, 4, 2) and late.soil is None and late.provenance is None
    np.testing.assert_allclose(late.start, driven.session("truck").state)
    # In time, the service answers although a fallback is there.
    assert driven.predict("truck", fan(2, 2), fallback=fallback).computed_by == "service"
    # A wrong question is not answered by the fallback.
    with pytest.raises(nesam.InvalidArgument):
        driven.predict("truck", fan(2, 33), fallback=fallback)


def test_service_fallback_of_a_planner_that_only_asks(server_address, driven):
    fallback = nesam.KinematicFallback(driven.session("truck").vehicle)
    newest_ns = driven.session("truck").last_stamp_ns
    asked_ns = newest_ns + 200_000_000
    # Somebody else feeds the session; this planner knows it from its predictions from now alone.
    with nesam.Client(server_address, timeout_s=60.0) as planner:
        # The ground is encoded once; what is known must not be old by then.
        planner.predict("truck", fan(2, 8))
        known = planner.predict("truck", fan(2, 8), start_stamp_ns=asked_ns, sent=[(newest_ns, (2.0, 0.0))], fallback=fallback)
        assert (known.computed_by, known.rolled_forward_steps, known.start_stamp_ns) == ("service", 2, asked_ns)
        sent = [(newest_ns, (2.0, 0.0)), (asked_ns, (1.5, 0.1))]
        question = dict(start_stamp_ns=asked_ns + 100_000_000, sent=sent, timeout_s=0.0, fallback=fallback)
        late = planner.predict("truck", fan(3, 24), **question)
        assert late.computed_by == "kinematic_fallback" and late.states.shape == (3, 24, 12)
        assert (late.rolled_forward_steps, late.start_stamp_ns) == (3, asked_ns + 100_000_000), "steps from the measurement, two of the service among them"
        np.testing.assert_allclose(late.start, fallback.rollout(known.start, np.float32([[[1.5, 0.1]]]))[0, 0], rtol=1e-6, atol=1e-6)
        # The fallback ranks nothing, and says which commands it predicts.
        drawing = nesam.Drawing(fan(1, 24)[0], samples=64, sd=(0.5, 0.1), seed=1)
        cost = nesam.PathCost(np.float32([[0, 0], [9, 0]]), 2.0, temperature=1.0)
        drawn = planner.predict("truck", drawing, cost=cost, **question)
        assert drawn.computed_by == "kinematic_fallback" and drawn.ranking is None
        np.testing.assert_array_equal(drawn.controls, fan(1, 24))
        # What it knows is too old to be carried on from.
        with pytest.raises(nesam.DeadlineExceeded):
            planner.predict("truck", fan(3, 24), **{**question, "start_stamp_ns": asked_ns + 3_300_000_000})


def test_analytic_a_known_state_is_rolled_forward_with_what_was_sent():
    fallback = nesam.KinematicFallback(nesam.VehicleCard("cart", "yaw_rate_rad_s", (-5.0, 5.0), (-1.0, 1.0), 1.0, 0.0))
    state = np.zeros(12)
    state[6], state[11] = 3.0, 0.5
    known = KnownState(state, 1_000_000_000)
    # One step as it moves, two steps straight on: the second command is in effect from the middle of the second step on.
    ahead = fallback.rolled_forward(known, 1_290_000_000, [(1_150_000_000, (2.0, 0.0))])
    assert (ahead.stamp_ns, ahead.rolled_forward_steps) == (1_300_000_000, 3)
    np.testing.assert_allclose(ahead.state[[0, 1, 5]], [6 * np.sin(0.05) + 0.4 * np.cos(0.05), 6 * (1 - np.cos(0.05)) + 0.4 * np.sin(0.05), 0.05])
    assert (ahead.state[6], ahead.state[11]) == (2.0, 0.0)
    # Nearer than half a step, or earlier, it is itself; 32 steps are rolled forward and no more.
    for until_ns in (1_049_000_000, 1_000_000_000, 0):
        same = fallback.rolled_forward(known, until_ns, [])
        assert (same.stamp_ns, same.rolled_forward_steps) == (known.stamp_ns, 0) and (same.state == state).all()
    assert fallback.rolled_forward(known, 4_200_000_000, []).rolled_forward_steps == 32
    assert fallback.rolled_forward(known, 4_300_000_000, []) is None


def test_service_away_is_unavailable_or_fallback():
    card = nesam.VehicleCard("cart", "yaw_rate_rad_s", (-1.0, 3.0), (-1.0, 1.0), 1.0, 0.0)
    with nesam.Client("127.0.0.1:1", timeout_s=0.5) as away:
        with pytest.raises((nesam.Unavailable, nesam.DeadlineExceeded)):
            away.sessions()
        start = np.zeros(12)
        prediction = away.predict("s", fan(3, 5), start=start, fallback=nesam.KinematicFallback(card))
        assert prediction.computed_by == "kinematic_fallback"


def with_number(values, at, number):
    """A copy of an array with another number at a place."""
    values = np.array(values)
    values[at] = number
    return values


def test_property_a_drawing_has_two_standard_deviations():
    with pytest.raises(ValueError, match="sd must be two numbers"):
        nesam.Drawing(fan(1, 5)[0], samples=4, sd=(0.1,)).message()


WRONG_COMMANDS = [
    pytest.param({"controls": with_number(fan(3, 5), (1, 2, 0), np.nan)}, "controls[1, 2]", id="not a number"),
    pytest.param({"controls": with_number(fan(3, 5), (2, 4, 1), np.inf)}, "controls[2, 4]", id="infinite"),
    pytest.param({"controls": with_number(fan(3, 5), (1, 3, 0), 99.0)}, "controls[1, 3].speed_m_s", id="too fast"),
    pytest.param({"controls": with_number(fan(3, 5), (0, 0, 1), -9.0)}, "controls[0, 0].second", id="too far to the right"),
    pytest.param({"controls": fan(3, 5, speed=99.0)}, "controls[0, 0].speed_m_s", id="the first of many"),
    pytest.param(
        {"controls": nesam.Drawing(with_number(fan(1, 5)[0], (2, 0), 99.0), samples=4, sd=(0.1, 0.1))}, "drawing.nominal[0, 2].speed_m_s", id="a drawing"
    ),
    pytest.param({"start": with_number(np.zeros(12), 3, np.nan)}, "start.attitude_rad.x", id="a start that is not a number"),
    pytest.param({"sent": [(0, (2.0, 0.0)), (1, (99.0, 0.0))], "start_stamp_ns": 4 * 10**9}, "sent[1].command.speed_m_s", id="sent too fast"),
    pytest.param({"sent": [(0, (2.0, np.nan))], "start_stamp_ns": 4 * 10**9}, "sent[0].command.second", id="sent and not a number"),
    pytest.param({"sent": [(5, (2.0, 0.0)), (5, (2.0, 0.0))], "start_stamp_ns": 4 * 10**9}, "sent[1].stamp_ns", id="sent in disorder"),
]


def drawing(**changes):
    return nesam.Drawing(**{"nominal": fan(1, 5)[0], "samples": 4, "sd": (0.1, 0.1), **changes})


def cost(**changes):
    return nesam.PathCost(**{"path": np.float32([[0, 0], [9, 0]]), "speed_m_s": 2.0, **changes})


WRONG_QUESTIONS = [
    pytest.param({"controls": fan(1, 64)}, "horizon", id="more steps than the model has"),
    pytest.param({"controls": np.zeros((1, 0, 2), np.float32)}, "horizon", id="no step"),
    pytest.param({"controls": np.zeros((0, 5, 2), np.float32)}, "samples", id="no sample"),
    pytest.param({"controls": drawing(samples=0)}, "samples", id="no sample drawn"),
    pytest.param({"stride": 6}, "output.stride", id="a stride beyond the horizon"),
    pytest.param({"samples_min": 4}, "samples_min", id="more than all"),
    pytest.param({"start": with_number(np.zeros(12), 1, 1e9)}, "start.position_m.y", id="far away"),
    pytest.param({"start": with_number(np.zeros(12), 4, 3.2)}, "start.attitude_rad.y", id="turned over"),
    pytest.param({"start": np.zeros(12), "start_stamp_ns": 4 * 10**9}, "start", id="from a state and an instant"),
    pytest.param({"sent": [(0, (2.0, 0.0))]}, "start_stamp_ns", id="sent before no instant"),
    pytest.param({"controls": drawing(sd=(-0.1, 0.1))}, "drawing.speed_sd_m_s", id="a negative deviation"),
    pytest.param({"controls": drawing(correlation=1.0)}, "drawing.correlation", id="noise that stays"),
    pytest.param({"cost": cost(path=np.float32([[0, 0], [np.nan, 0]]))}, "cost.path", id="a path that is none"),
    pytest.param({"cost": cost(path=np.zeros((1, 2)))}, "cost.path", id="a path of one point"),
    pytest.param({"cost": cost(tilt_weight=-1.0)}, "cost.tilt_weight", id="a negative weight"),
    pytest.param({"cost": cost(speed_m_s=np.inf)}, "cost.speed_m_s", id="an infinite speed"),
    pytest.param({"cost": cost(best=4)}, "cost.best", id="more of the best than there are"),
    pytest.param({"cost": cost(), "extras": nesam.Extras(risk=True)}, "cost", id="a cost and extras"),
]


@pytest.fixture
def away(driven):
    """A client that knows what `driven` knows, of a service that is not there."""
    with nesam.Client("127.0.0.1:1") as alone:
        alone._known_states = driven._known_states
        yield alone


@pytest.mark.parametrize("asked, field", WRONG_COMMANDS)
def test_service_a_fallback_refuses_what_the_service_does(driven, away, asked, field):
    """Method: the same question to the service, and where only a fallback would answer."""
    question = {"controls": fan(3, 5), "fallback": nesam.KinematicFallback(driven.session("truck").vehicle), **asked}
    refusals = []
    for client in (driven, away):
        with pytest.raises(nesam.InvalidArgument) as refused:
            client.predict("truck", **question)
        refusals.append(refused.value)
    of_the_service, of_the_fallback = refusals
    assert of_the_service.field == of_the_fallback.field == field and of_the_service.code == of_the_fallback.code
    # The service may be told other limits of a start.
    told = of_the_service.message.split(" of magnitude up to")[0].replace("NaN", "nan")
    assert of_the_fallback.message.split(" of magnitude up to")[0] == told


@pytest.mark.parametrize("asked, field", WRONG_QUESTIONS)
def test_service_a_fallback_answers_no_question_that_the_service_refuses(driven, away, asked, field):
    """Method: as before; numbers of the limits, which the service may be told otherwise, are not compared."""
    question = {"controls": fan(3, 5), "fallback": nesam.KinematicFallback(driven.session("truck").vehicle), **asked}
    for client in (driven, away):
        with pytest.raises(nesam.InvalidArgument) as refused:
            client.predict("truck", **question)
        assert refused.value.field == field, refused.value


def test_service_a_fallback_admits_the_ends_of_the_range_as_the_service_does(driven, away):
    card = driven.session("truck").vehicle
    ends = np.stack(np.meshgrid(card.speed_range_m_s, card.second_range), axis=-1).reshape(4, 1, 2).astype(np.float32)
    assert driven.predict("truck", ends).computed_by == "service"
    assert away.predict("truck", ends, fallback=nesam.KinematicFallback(card)).computed_by == "kinematic_fallback"
    # The number next to a tenth in float32 lies above it in float64.
    narrow = nesam.KinematicFallback(replace(card, speed_range_m_s=(-0.1, 0.1), second_range=(-0.1, 0.1)))
    narrow.check(np.full((1, 1, 2), 0.1, np.float32), [(0, (0.1, -0.1))])
    with pytest.raises(nesam.InvalidArgument, match=r"controls\[0, 0\].second"):
        narrow.check(np.array([[[0.1, 0.10001]]]))


def test_analytic_fallback_drives_arcs():
    card = nesam.VehicleCard("cart", "road_wheel_angle_rad", (-5.0, 5.0), (-0.5, 0.5), 2.5, 0.5)
    start = np.zeros(12)
    start[5] = np.pi / 2
    controls = np.zeros((2, 32, 2), dtype=np.float32)
    controls[:, :, 0] = 2.0
    controls[1, :, 1] = 0.3
    states = nesam.KinematicFallback(card).rollout(start, controls)
    np.testing.assert_allclose(states[0, :, 1], 0.2 * np.arange(1, 33), rtol=1e-6)
    # A left arc of radius wheelbase / tan(angle) around a centre to the left.
    radius = 2.5 / np.tan(np.float32(0.3))
    distance = np.hypot(states[1, :, 0] + radius, states[1, :, 1])
    np.testing.assert_allclose(distance, radius, rtol=1e-5)
    assert (np.abs(states[..., 5]) <= np.pi + 1e-6).all() and states[1, -1, 11] == pytest.approx(2.0 / radius)


def test_service_threads_share_a_client(driven):
    expected = driven.predict("truck", fan(4, 8)).states
    seen = []
    threads = [threading.Thread(target=lambda: seen.append(driven.predict("truck", fan(4, 8)).states)) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 6 and all((states == expected).all() for states in seen)


def test_service_example_planner_reaches_its_goal(server_address):
    script = Path(__file__).resolve().parents[2] / "examples" / "planner.py"
    done = subprocess.run([sys.executable, str(script), server_address], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "goal reached" in done.stdout
