"""Goal: both clients hear a diagnosis and why there is none. Method: real servers that record and that do not; messages as the service sends them."""

import asyncio
import time

import pytest

import nesam
from conftest import start_server, straight
from nesam import _diagnosis
from nesam.v1 import diagnosis_pb2, effects_pb2


@pytest.fixture(scope="module")
def recording_server(request, tmp_path_factory):
    """A server that records, with a session "truck" that has driven for 8 s."""
    folder = tmp_path_factory.mktemp("recording")
    process, address = start_server(request, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--record", "run", folder=folder)
    with nesam.Client(address, timeout_s=60.0) as client:
        client.open_session("truck")
        client.measure(straight("truck", 80))
    yield address
    process.terminate()
    assert process.wait(timeout=30) == 0, "the server did not shut down cleanly"


def test_service_both_clients_hear_the_start_and_the_words_of_the_command(recording_server):
    heard, told, asked = [], [], {"from_stamp_ns": 0, "to_stamp_ns": 3_000_000_000}

    async def hear():
        async with nesam.AsyncClient(recording_server) as client:
            async for event in client.diagnose("truck", **asked):
                told.append(event)

    with nesam.Client(recording_server) as client:
        # Too little of the drive to be judged.
        with pytest.raises(nesam.FailedPrecondition, match="has no 4 s of measurements"):
            for event in client.diagnose("truck", **asked):
                heard.append(event)
    with pytest.raises(nesam.FailedPrecondition, match="has no 4 s of measurements"):
        asyncio.run(hear())
    for events in (heard, told):
        started = events[0]
        assert isinstance(started, nesam.DiagnosisStarted) and started.recording.startswith("nesam-")
        assert (started.from_stamp_ns, started.to_stamp_ns) == (0, 3_000_000_000)
    assert heard[0].diagnosis_id != told[0].diagnosis_id


def begun(client, within_s=20.0):
    """The events of a diagnosis after the start; one that was left a moment ago may still be ending."""
    until = time.monotonic() + within_s
    while True:
        events = client.diagnose("truck")
        try:
            assert isinstance(next(events), nesam.DiagnosisStarted)
            return events
        except nesam.Overloaded:
            assert time.monotonic() < until, "leaving a diagnosis does not end it"
            time.sleep(0.05)


def test_service_leaving_the_iterator_makes_room(recording_server):
    with nesam.Client(recording_server) as client:
        for _ in range(3):
            begun(client).close()


def test_service_what_cannot_begin_is_refused_by_field(client):
    for arguments, error, field in [
        (("truck",), nesam.FailedPrecondition, "recording"),
        (("truck", "elsewhere"), nesam.NotFound, "recording"),
        (("",), nesam.InvalidArgument, "session_id"),
        (("truck", "", 2, 1), nesam.InvalidArgument, "to_stamp_ns"),
    ]:
        with pytest.raises(error) as refused:
            next(client.diagnose(*arguments))
        assert refused.value.field == field
    with pytest.raises(ValueError, match="reference"):
        client.diagnose("truck", reference="feeling")


def test_analytic_events_are_read():
    effect = effects_pb2.Effect(id="speed_gain", parameters=[effects_pb2.EffectParameter(name="relative", value=0.1, sd=0.01)])
    report = diagnosis_pb2.DiagnosisReport(
        diagnosis_id="d", verdict=diagnosis_pb2.DIAGNOSIS_VERDICT_EXPLAINED, reason="r", effects=[effect], json="{}", folder="f", bundle="b", bundle_hash="h", notes=["n"]
    )
    read = _diagnosis.event(diagnosis_pb2.DiagnosisEvent(report=report))
    assert read == nesam.DiagnosisReport("d", "explained", "r", (nesam.Effect("speed_gain", {"relative": 0.1}, {"relative": 0.01}),), "{}", "f", "b", "h", ("n",))
    progress = diagnosis_pb2.DiagnosisProgress(stage="hypotheses", done=1, total=3)
    assert _diagnosis.event(diagnosis_pb2.DiagnosisEvent(progress=progress)) == nesam.DiagnosisProgress("hypotheses", 1, 3)
    asked = _diagnosis.request("s", "", None, -5, None, "physics", False)
    assert (asked.HasField("from_stamp_ns"), asked.to_stamp_ns, asked.HasField("seed")) == (False, -5, False)
    assert asked.without_controls and asked.reference == diagnosis_pb2.DIAGNOSIS_REFERENCE_PHYSICS
