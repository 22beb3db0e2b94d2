"""Goal: a fallback begins at the newest state of its session, and at none that is old or another session's. Method: what was sent and heard in another order, under
a clock of the test; services that fall silent, go, or know nothing new."""

import asyncio
from types import SimpleNamespace

import grpc
import numpy as np
import pytest
from conftest import straight
from test_client import fan
from test_connection import at_once, listening, measurements, never

import nesam
from nesam import _calls
from nesam._calls import KnownStates, Question
from nesam.v1 import measurements_pb2, prediction_pb2

CARD = nesam.VehicleCard("cart", "yaw_rate_rad_s", (-1.0, 3.0), (-1.0, 1.0), 1.0, 0.0)
LATE = nesam.DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "", "late")


class Known(KnownStates):
    """What is known of the session "s", told by stamps."""

    def measurement(self, stamp_ns):
        return self.report(nesam.Measurement("s", stamp_ns, np.full(12, float(stamp_ns)), (0.0, 0.0)))

    def hear(self, reported, outcome, **answer):
        self.measured(reported, SimpleNamespace(**{"outcome": outcome, "reordered": False, "code": 0, "field": "", **answer}))
        return self.newest()

    def begins(self, asked, stamp_ns, age_s=0.0, steps=0, **question):
        """Hears of a prediction that began there, so many steps after a measurement."""
        began = {"start": np.full(12, float(stamp_ns)), "start_stamp_ns": stamp_ns, "measurement_age_s": age_s, "rolled_forward_steps": steps}
        self.predicted(asked, Question("s", fan(1, 1), **question), SimpleNamespace(**began))
        return self.newest()

    def newest(self):
        """Stamp of where a fallback begins; None where it does not."""
        begin = self.from_(None)
        return None if begin is None else begin[0]

    def from_(self, instant_ns):
        """Stamp of where a fallback begins that is asked from an instant, and the steps from the measurement; None where it does not."""
        try:
            prediction = self.fall_back(Question("s", fan(1, 1), fallback=nesam.KinematicFallback(CARD), start_stamp_ns=instant_ns), LATE)
            return prediction.start_stamp_ns, prediction.rolled_forward_steps
        except nesam.DeadlineExceeded:
            return None


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes when it is told to, s."""
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(_calls, "time", SimpleNamespace(monotonic=lambda: now.s))
    return now


def test_analytic_what_was_asked_for_earlier_replaces_only_what_is_older():
    known = Known()
    late, ahead = known.ask(), known.ask()
    assert known.hear(known.measurement(200), "APPLIED") == 200
    assert known.begins(late, 100) == 200, "it was asked for before the measurement and is older"
    assert known.begins(ahead, 300) == 300, "somebody else had measured more"
    assert known.hear(known.measurement(250), "APPLIED") == 250, "what was sent later tells what the session has now"
    of_the_old_clock, jump, after = known.ask(), known.measurement(10), known.ask()
    assert known.begins(after, 260) == 260
    assert known.hear(jump, "CLOCK_JUMP") == 10, "stamps of before say nothing"
    assert known.begins(of_the_old_clock, 400) == 10, "the clock has begun anew since"
    assert known.hear(known.measurement(20), "APPLIED") == 20
    assert known.hear(known.measurement(5), "RESTARTED") == 5
    assert known.begins(after, 500) == 5, "the vehicle has been restarted since"
    assert known.begins(known.ask(), 7) == 7


def test_analytic_a_measurement_counts_whatever_became_of_it_unless_it_is_refused():
    known = Known()
    assert known.hear(known.measurement(10), "APPLIED") == 10
    assert known.hear(known.measurement(11), "BUFFERED") == 11, "it waits for the grid, the vehicle is there"
    assert known.begins(known.ask(), 10) == 11, "the step before it is older"
    assert known.begins(known.ask(), 20) == 20
    known.unheard(known.measurement(30))
    assert known.newest() == 30, "it got no answer"
    assert known.hear(known.measurement(40), "REJECTED", code=grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]) == 40, "there was no room"
    for refused in ("TOO_OLD", "FUTURE", "NOT_FINITE", "DUPLICATE", "REJECTED"):
        assert known.hear(known.measurement(50), refused) == 40
    assert known.hear(known.measurement(50), "APPLIED", reordered=True) == 40
    known.unheard(known.report(nesam.Measurement("s", 60, np.full(12, np.nan), (0.0, 0.0))))
    assert known.newest() == 40, "it is nowhere"
    known.unheard(known.measurement(35))
    assert known.newest() == 40, "kept since before, sent again"


def test_regress_a_state_that_was_rolled_forward_is_no_measurement():
    """Method: a measurement at 1 s, and predictions that the service rolled forward from it; who asks plainly, from earlier or from later than they began, and after
    a newer measurement. Then a planner that only asks."""
    known, tenth = Known(), 100_000_000
    second = 10 * tenth
    known.hear(known.measurement(second), "APPLIED")
    late = known.ask()
    known.begins(known.ask(), second + 8 * tenth, steps=8, start_stamp_ns=second + 8 * tenth)
    assert known.newest() == second, "what was measured"
    assert known.from_(second) == (second, 0) and known.from_(second + tenth) == (second + tenth, 1), "not later than was asked"
    assert known.from_(second + 9 * tenth) == (second + 9 * tenth, 9), "steps count from the measurement"
    assert known.from_(second + 32 * tenth) == (second + 32 * tenth, 32) and known.from_(second + 33 * tenth) is None
    known.begins(known.ask(), second + 2 * tenth, steps=2, start_stamp_ns=second + 2 * tenth)
    known.begins(late, second + 5 * tenth, steps=5, start_stamp_ns=second + 5 * tenth)
    asked = Question("s", fan(1, 1), fallback=nesam.KinematicFallback(CARD), start_stamp_ns=second + 2 * tenth)
    assert known.fall_back(asked, LATE).start[0] == second + 2 * tenth, "the last answer, as the service rolled it"
    known.hear(known.measurement(second + tenth), "APPLIED")
    assert known.newest() == second + tenth and known.from_(second + 3 * tenth) == (second + 3 * tenth, 2), "a newer measurement"
    # Measurements overtake a question: the step that was measured then is older.
    known.begins(known.ask(), second, start_stamp_ns=second)
    assert known.newest() == second + tenth
    known.hear(known.measurement(5), "CLOCK_JUMP")
    assert known.newest() == 5 and known.from_(second + 9 * tenth) == (5 + 19 * tenth, 19), "what was rolled forward is of the clock before"
    known.opened(SimpleNamespace(session_id="s"))
    known.begins(known.ask(), second, steps=3, start_stamp_ns=second)
    assert known.newest() == second and known.from_(second + tenth) == (second + tenth, 4), "nothing was measured here"
    assert known.from_(second - tenth) is None, "and nothing is known of before"
    known.forget("s")
    assert known.newest() is None


def test_analytic_a_state_is_a_copy_of_what_was_sent():
    known, state = Known(), np.zeros(12)
    sent = known.report(nesam.Measurement("s", 1, state, (0.0, 0.0)))
    state[0] = 9.0
    known.hear(sent, "APPLIED")
    assert known._states["s"].known.state[0] == 0.0


def test_analytic_a_state_grows_too_old(clock):
    known = Known()
    assert known.hear(known.measurement(10), "APPLIED") == 10
    clock.s += 3.1
    assert known.newest() == 10
    clock.s += 0.2
    assert known.newest() is None
    # The same one sent again is as old; one that is heard late is as old as its sending.
    known.unheard(known.measurement(10))
    assert known.newest() is None
    sent, asked = known.measurement(20), known.ask()
    clock.s += 3.3
    assert known.hear(sent, "APPLIED") is None
    # What a prediction began at is as old as it says.
    assert known.begins(asked, 30) is None and known.begins(known.ask(), 40, age_s=4.0) is None and known.begins(known.ask(), 50, age_s=3.0) == 50
    # One that is no step yet holds nothing up for longer.
    known.unheard(known.measurement(90))
    assert known.newest() == 90 and known.hear(known.measurement(60), "APPLIED") == 90
    clock.s += 3.3
    assert known.hear(known.measurement(60), "APPLIED") == 60


def test_analytic_a_session_of_the_same_name_is_another_one():
    known = Known()
    assert known.hear(known.measurement(10), "APPLIED") == 10
    sent, asked = known.measurement(20), known.ask()
    known.opened(SimpleNamespace(session_id="s"))
    assert known.newest() is None
    assert known.hear(sent, "APPLIED") is None and known.begins(asked, 30) is None, "they are of the session before"
    known.unheard(sent)
    assert known.newest() is None
    assert known.hear(known.measurement(1), "APPLIED") == 1
    # The service says that it is not there any more.
    with pytest.raises(nesam.NotFound):
        known.fall_back(Question("s", fan(1, 1)), nesam.NotFound(grpc.StatusCode.NOT_FOUND, "session_id", "unknown"))
    assert known.newest() is None
    known.hear(known.measurement(2), "APPLIED")
    assert known.hear(known.measurement(3), "REJECTED", code=grpc.StatusCode.NOT_FOUND.value[0], field="session_id") is None


def test_service_a_session_that_is_opened_again_begins_nowhere(client, server_address):
    question = {"controls": fan(1, 4), "fallback": nesam.KinematicFallback(client.open_session("truck").vehicle), "timeout_s": 0.0}
    client.measure(straight("truck", 3))
    assert client.predict("truck", **question).computed_by == "kinematic_fallback"
    image = client.export_session("truck")
    for again in (lambda: client.open_session("truck"), lambda: client.import_session(image), lambda: client.fork_session("other", "truck")):
        # Somebody else closes it.
        with nesam.Client(server_address) as other:
            other.close_session("truck")
            if "other" not in [session.session_id for session in other.sessions()]:
                other.open_session("other")
        again()
        with pytest.raises(nesam.DeadlineExceeded):
            client.predict("truck", **question)
        client.measure(straight("truck", 3))


def refusing(code, field):
    """A service of predictions that refuses all."""

    def refuse(_, context):
        context.set_trailing_metadata((("nesam-field", field),))
        context.abort(code, "no")

    method = grpc.unary_unary_rpc_method_handler(refuse, prediction_pb2.PredictRequest.FromString, prediction_pb2.PredictReply.SerializeToString)
    return ("nesam.v1.Prediction", "Predict", method)


@pytest.mark.parametrize("field, falls_back", [("start_stamp_ns", True), ("", False)])
def test_service_who_knows_nothing_new_is_as_good_as_late(field, falls_back):
    """A link that stalls: the newest measurement is too old to be rolled forward to now and 30 steps on. No measurement at all is no such case."""
    question = {"controls": fan(2, 30), "start": None, "start_stamp_ns": 500_000_000, "fallback": nesam.KinematicFallback(CARD)}

    async def in_asyncio(address):
        async with nesam.AsyncClient(address) as client:
            await client.measure(straight("truck", 3))
            return await client.predict("truck", **question)

    def in_threads(address):
        with nesam.Client(address) as client:
            client.measure(straight("truck", 3))
            return client.predict("truck", **question)

    with listening(measurements(at_once), refusing(grpc.StatusCode.FAILED_PRECONDITION, field)) as address:
        for predict in (in_threads, lambda address: asyncio.run(in_asyncio(address))):
            if falls_back:
                prediction = predict(address)
                assert prediction.computed_by == "kinematic_fallback" and isinstance(prediction.fallback_reason, nesam.FailedPrecondition)
                assert (prediction.rolled_forward_steps, prediction.start_stamp_ns) == (3, 500_000_000)
            else:
                with pytest.raises(nesam.FailedPrecondition):
                    predict(address)


def gone_after(answers):
    """A service that answers so many measurements of a stream and ends it."""

    def few(requests, context):
        for i, request in enumerate(requests):
            if i == answers:
                context.abort(grpc.StatusCode.UNAVAILABLE, "going")
            yield measurements_pb2.MeasurementAnswer(sequence=request.sequence, applied=measurements_pb2.Applied())

    return measurements(few)


AWAY = refusing(grpc.StatusCode.UNAVAILABLE, "")


def begun_at(client, session_id="truck"):
    return client.predict(session_id, fan(1, 4), fallback=nesam.KinematicFallback(CARD)).start[0]


def test_service_a_fallback_follows_a_vehicle_that_gets_no_answers():
    drive = list(straight("truck", 6))
    where = [measurement.state[0] for measurement in drive]
    with listening(gone_after(2), AWAY) as address, nesam.Client(address) as client, client.measurement_stream() as stream:
        stream.send(drive[0])
        stream.send(drive[1])
        for i in (2, 3, 4):
            with pytest.raises(nesam.Unavailable):
                stream.send(drive[i])
            assert begun_at(client) == where[i], i
        with pytest.raises(nesam.Unavailable):
            client.measure(drive[:4])
        assert begun_at(client) == where[4], "those that were kept are older"
    with listening(measurements(never), AWAY) as address, nesam.Client(address, timeout_s=0.1) as client:
        with pytest.raises(nesam.DeadlineExceeded):
            client.measure(drive)
        assert begun_at(client) == where[5]
        with client.durable_stream("other", reconnect_s=0.2) as stream:
            for measurement in straight("other", 2):
                with pytest.raises(nesam.Unavailable):
                    stream.send(measurement)
        assert begun_at(client, "other") == where[1], "the newest, not the oldest that is kept"


def test_service_a_fallback_follows_a_vehicle_that_gets_no_answers_in_asyncio():
    first, second, third = straight("truck", 3)

    async def begun(client):
        return (await client.predict("truck", fan(1, 4), fallback=nesam.KinematicFallback(CARD))).start[0]

    async def work(address):
        async with nesam.AsyncClient(address, timeout_s=0.1) as client, client.measurement_stream() as stream:
            with pytest.raises(nesam.DeadlineExceeded):
                await stream.send(first)
            at_first = await begun(client)
            with pytest.raises(nesam.Unavailable):
                await stream.send(second)
            async with client.durable_stream("truck", reconnect_s=0.2) as durable:
                with pytest.raises(nesam.Unavailable):
                    await durable.send(third)
            return at_first, await begun(client)

    with listening(measurements(never), AWAY) as address:
        assert asyncio.run(work(address)) == (first.state[0], third.state[0])
