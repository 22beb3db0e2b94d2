"""Goal: what a durable stream keeps reaches a session that is closed and opened again, the oldest first, and what it cannot take is told. Method: a real server with a
store; the session is opened again by the same client, by another one, and late; refusals of what a session has and has not, told by the test."""

import asyncio
import pickle

import numpy as np
import pytest
from conftest import start_server, straight

import nesam
from nesam._kept import Kept


@pytest.fixture
def address(request, tmp_path):
    """Of a server with a store."""
    process, address = start_server(request, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--store", str(tmp_path / "store"))
    yield address
    process.terminate()
    assert process.wait(timeout=30) == 0


class Awaited:
    """A client or a stream of asyncio as one of threads."""

    def __init__(self, loop, awaited):
        self._loop, self._awaited = loop, awaited

    def __getattr__(self, name):
        member = getattr(self._awaited, name)
        if name == "durable_stream":
            return lambda *given, **options: Awaited(self._loop, self._made(member, given, options))
        return (lambda *given, **options: self._loop.run_until_complete(member(*given, **options))) if callable(member) else member

    def _made(self, member, given, options):
        async def inside():
            return member(*given, **options)

        return self._loop.run_until_complete(inside())


@pytest.fixture(params=["threads", "tasks"])
def own(request, address):
    """The client of the vehicle."""
    if request.param == "threads":
        with nesam.Client(address, timeout_s=20.0) as client:
            yield client
        return
    loop = asyncio.new_event_loop()

    async def inside():
        return nesam.AsyncClient(address, timeout_s=20.0)

    client = Awaited(loop, loop.run_until_complete(inside()))
    yield client
    client.close()
    loop.close()


@pytest.fixture
def planner(address):
    """Another client."""
    with nesam.Client(address, timeout_s=20.0) as client:
        yield client


DRIVE = list(straight("truck", 12))


def in_order(client, count):
    """Whether the session has the first so many measurements of the drive, in their order."""
    session = client.session("truck")
    np.testing.assert_array_equal(session.state, DRIVE[count - 1].state)
    return (session.accepted, session.durable_place, session.history_steps, session.last_sequence) == (count,) * 4


def test_service_who_opens_the_session_again_itself_loses_nothing(own):
    own.open_session("truck")
    stream = own.durable_stream("truck")
    for measurement in DRIVE[:8]:
        assert stream.send(measurement).outcome == "APPLIED"
    own.close_session("truck")
    own.open_session("truck")
    answer = stream.send(DRIVE[8])
    assert (answer.outcome, answer.sequence, answer.place) == ("APPLIED", 9, 9)
    stream.flush()
    assert not stream.pending and in_order(own, 9)
    stream.close()


def test_service_what_is_sent_while_the_session_is_not_open_is_kept(own, planner):
    stream = own.durable_stream("truck")
    answer = stream.send(DRIVE[0])
    assert (answer.outcome, answer.field, answer.sequence) == ("REJECTED", "session_id", 1)
    planner.open_session("truck")
    for measurement in DRIVE[1:6]:
        assert stream.send(measurement).outcome == "APPLIED"
    planner.close_session("truck")
    for measurement in DRIVE[6:9]:
        answer = stream.send(measurement)
        assert (answer.outcome, answer.field, answer.stamp_ns) == ("REJECTED", "session_id", measurement.stamp_ns)
    with pytest.raises(nesam.NotFound):
        stream.flush()
    kept = [measurement.sequence for measurement in stream.pending]
    assert kept == list(range(10 - len(kept), 10)) and len(kept) >= 3
    planner.open_session("truck")
    answer = stream.send(DRIVE[9])
    assert (answer.outcome, answer.place) == ("APPLIED", len(kept) + 1)
    stream.flush()
    assert not stream.pending and planner.session("truck").accepted == len(kept) + 1
    stream.close()


def opened_again_after_eight(own, planner):
    """A stream that has sent eight, whose session another client has closed and opened since, and what it kept before that."""
    planner.open_session("truck")
    stream = own.durable_stream("truck")
    for measurement in DRIVE[:8]:
        stream.send(measurement)
    kept = [measurement.sequence for measurement in stream.pending]
    planner.close_session("truck")
    planner.open_session("truck")
    return stream, kept


def test_service_a_flush_notices_that_another_opened_the_session_again(own, planner):
    stream, kept = opened_again_after_eight(own, planner)
    stream.flush()
    assert not stream.pending and planner.session("truck").accepted == len(kept)
    stream.close()


def test_service_what_the_new_session_cannot_take_is_told(own, planner):
    """Another client opens it between two measurements: only the answer to the next shows it."""
    stream, kept = opened_again_after_eight(own, planner)
    assert len(kept) > 3, "the test is quicker than the store"
    with pytest.raises(nesam.Refused, match=f"{len(kept) - 1} kept measurements .* number {kept[0]}: TOO_OLD") as refused:
        stream.send(DRIVE[8])
    told = refused.value
    assert [(measurement.sequence, answer.outcome) for measurement, answer in told.refused] == [(number, "TOO_OLD") for number in kept[:-1]]
    assert (told.answer.outcome, told.answer.sequence) == ("APPLIED", 9)
    assert [measurement.sequence for measurement in stream.pending] == [8, 9]
    copy = pickle.loads(pickle.dumps(told))
    assert str(copy) == str(told) and len(copy.refused) == len(told.refused)
    # It is told once, and the stream goes on.
    assert stream.send(DRIVE[9]).place == 3
    stream.flush()
    session = planner.session("truck")
    assert not stream.pending and (session.accepted, session.durable_place, session.history_steps) == (3, 3, 3)
    # By `flush` where nothing is sent meanwhile: the new session begins with a newer measurement.
    stream.send(DRIVE[10])
    kept = [measurement.sequence for measurement in stream.pending]
    planner.close_session("truck")
    planner.open_session("truck", initial=list(straight("truck", 40))[-1])
    with pytest.raises(nesam.Refused) as refused:
        stream.flush()
    assert [measurement.sequence for measurement, _ in refused.value.refused] == kept == [11] and refused.value.answer is None
    stream.flush()
    stream.close()


def answer(outcome, place=0, run=1, durable_place=0):
    return nesam.Answer(outcome, "truck", 0, 0, 0, 0, place=place, run=run, durable_place=durable_place)


def kept_of(*numbers):
    """What is kept of so many that were applied, before its connection broke."""
    kept = Kept("truck", 100)
    for number in numbers:
        kept.put(DRIVE[number - 1])
        kept.answered(answer("APPLIED", number))
    kept.forget_places()
    return kept


def refused(kept):
    try:
        kept.tell_refused()
    except nesam.Refused as error:
        return [measurement.sequence for measurement, _ in error.refused]
    return []


def test_analytic_what_a_session_has_is_not_missing_when_it_is_refused_again():
    """As of an earlier start of the vehicle: too old now."""
    kept = kept_of(1, 2, 3)
    for again in (answer("TOO_OLD"), answer("DUPLICATE", 3), answer("DUPLICATE", 3)):
        told = kept.answered(again)
    assert (told.outcome, told.place) == ("APPLIED", 3) and refused(kept) == []


def test_analytic_what_another_session_refuses_is_missing():
    kept = kept_of(1, 2, 3)
    kept.answered(answer("TOO_OLD", run=2))
    kept.answered(answer("APPLIED", 1, run=2))
    assert refused(kept) == [1], "another run"
    assert refused(kept) == [], "once"
    # The same run may have it, until it counts from 1: then all go to it, the oldest first.
    kept = kept_of(1, 2, 3)
    kept.answered(answer("TOO_OLD"))
    with pytest.raises(nesam.Unavailable):
        kept.answered(answer("APPLIED", 1))
    kept.forget_places()
    assert refused(kept) == [] and kept.next.sequence == 1
    kept.answered(answer("TOO_OLD"))
    kept.answered(answer("DUPLICATE", 1))
    assert refused(kept) == [1] and kept.next.sequence == 3


def test_regress_what_the_session_does_not_know_again_keeps_its_place():
    """Two boots, of which the first is over when all go again over another connection: what the session has of it is TOO_OLD, and kept until it is durable."""
    kept = kept_of(1, 2, 3)
    for _ in range(2):
        kept.answered(answer("TOO_OLD", durable_place=3))
    assert len(kept) == 3, "an answer without a place does not say that the session is the same"
    kept.answered(answer("DUPLICATE", 3, durable_place=1))
    assert [measurement.sequence for measurement in kept.pending] == [2, 3] and refused(kept) == []
    # Another client opened the session anew: what is durable there is not what this one has sent.
    kept = kept_of(1)
    kept.answered(answer("DUPLICATE", 1))
    kept.put(DRIVE[3])
    kept.answered(answer("TOO_OLD", durable_place=9))
    assert [measurement.sequence for measurement in kept.pending] == [1] and refused(kept) == [4]
    # One that never had a place: nobody was told of it, as its connection broke.
    kept = kept_of(1)
    kept.put(DRIVE[1])
    kept.put(DRIVE[2])
    kept.answered(answer("DUPLICATE", 1))
    kept.answered(answer("NOT_FINITE"))
    newest = answer("FUTURE")
    assert kept.answered(newest) is newest
    with pytest.raises(nesam.Refused) as error:
        kept.tell_refused(newest)
    assert [measurement.sequence for measurement, _ in error.value.refused] == [2], "the newest is told as its answer"
