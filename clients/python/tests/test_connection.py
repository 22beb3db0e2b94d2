"""Goal: every call brings its vehicle along, takes large replies, and is given up when nobody answers it. Method: listeners in the place of the service, which
look at metadata, answer much, late or never."""

import asyncio
import signal
import time
from concurrent import futures
from contextlib import contextmanager

import grpc
import numpy as np
import pytest
from conftest import straight

import nesam
from nesam.v1 import alarms_pb2, diagnosis_pb2, measurements_pb2, sessions_pb2, soil_pb2, types_pb2


@contextmanager
def listening(*services, interceptors=()):
    """The address of a server with these services, (name, method, handler)."""
    server = grpc.server(futures.ThreadPoolExecutor(8), interceptors=interceptors)
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler(name, {method: handler}) for name, method, handler in services])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}"
    server.stop(None)


def measurements(stream):
    """The service of measurements by a function of requests and context."""
    read, write = measurements_pb2.Measurement.FromString, measurements_pb2.MeasurementAnswer.SerializeToString
    return ("nesam.v1.Measurements", "Stream", grpc.stream_stream_rpc_method_handler(stream, read, write))


def never(requests, _):
    """Hears everything and answers nothing, as a process that stands still."""
    for _ in requests:
        pass
    return iter(())


def at_once(requests, _):
    for request in requests:
        yield measurements_pb2.MeasurementAnswer(sequence=request.sequence, applied=measurements_pb2.Applied())


class Vehicles(grpc.ServerInterceptor):
    """The vehicle that each call names, by method."""

    def __init__(self):
        self.told = {}

    def intercept_service(self, continuation, details):
        self.told[details.method.rsplit("/", 1)[1]] = dict(details.invocation_metadata).get("x-vehicle-id")
        return continuation(details)


def test_service_calls_of_all_shapes_name_their_vehicle(hills):
    asked = {"Get": "truck-7", "UploadMap": "truck-7", "WatchAlarms": "truck-7", "Watch": "truck-7", "Stream": "truck-7"}
    measurement = next(straight("truck", 1))
    vehicles = Vehicles()
    with listening(interceptors=[vehicles]) as address:
        # Nobody answers here: UNIMPLEMENTED.
        with nesam.Client(address, vehicle_id="truck-7") as client:
            for call in (
                lambda: client.session("s"),
                lambda: client.upload_map(hills),
                lambda: next(client.alarms("s")),
                lambda: next(client.watch_soil("s")),
                lambda: client.measure([measurement]),
            ):
                with pytest.raises(nesam.NesamError):
                    call()
        assert vehicles.told == asked
        vehicles.told.clear()

        async def work():
            async with nesam.AsyncClient(address, vehicle_id="truck-7") as client:
                for call in (
                    lambda: client.session("s"),
                    lambda: client.upload_map(hills),
                    lambda: client.alarms("s").__anext__(),
                    lambda: client.watch_soil("s").__anext__(),
                    lambda: client.measurement_stream().send(measurement),
                ):
                    with pytest.raises(nesam.NesamError):
                        await call()

        asyncio.run(work())
        assert vehicles.told == asked


def test_service_a_full_soil_map_is_read():
    vector = types_pb2.SoilVector(k_phi=0.1, k_c=0.1, n=0.1, c_pa=0.1, phi_rad=0.1, k_shear_m=0.1)
    cell = soil_pb2.FleetSoilCell(
        map_id="quarry-7", colour_rgb=0x806040, column=-12, row=40, information=[0.1] * 36, vector=vector, buffers=0.1, age_s=0.1
    )
    cells = 65_536  # as many as a server keeps by default
    full = soil_pb2.FleetSoilMap(cell_m=10.0, cells=[cell] * cells)
    handler = grpc.unary_unary_rpc_method_handler(lambda *_: full, None, soil_pb2.FleetSoilMap.SerializeToString)
    with listening(("nesam.v1.Soil", "Map", handler)) as address, nesam.Client(address, timeout_s=60.0) as client:
        assert full.ByteSize() > 16 << 20 and len(client.fleet_soil().cells) == cells


def test_service_a_silent_service_is_given_up():
    drive = list(straight("truck", 40))

    def slowly():
        for measurement in drive:
            time.sleep(0.1)
            yield measurement

    with listening(measurements(never)) as address:
        with nesam.Client(address, timeout_s=0.5) as client:
            for call in (
                lambda: client.measure(drive),
                lambda: client.measure(slowly()),
                lambda: client.measurement_stream().send(drive[0]),
                lambda: client.measurement_stream().send(drive[0], timeout_s=0.4),
            ):
                begun = time.monotonic()
                with pytest.raises(nesam.DeadlineExceeded):
                    call()
                assert 0.3 < time.monotonic() - begun < 2.0
            stream = client.measurement_stream()
            with pytest.raises(nesam.DeadlineExceeded):
                stream.send(drive[0])
            with pytest.raises(nesam.Unavailable):
                stream.send(drive[1])

        async def work():
            async with nesam.AsyncClient(address, timeout_s=0.5) as client, client.measurement_stream() as stream:
                with pytest.raises(nesam.DeadlineExceeded):
                    await stream.send(drive[0])
                with pytest.raises(nesam.Unavailable):
                    await stream.send(drive[1])
                for measurements in (drive, slowly_in_asyncio()):
                    begun = time.monotonic()
                    with pytest.raises(nesam.DeadlineExceeded):
                        await client.measure(measurements)
                    assert 0.3 < time.monotonic() - begun < 2.0

        async def slowly_in_asyncio():
            for measurement in drive:
                await asyncio.sleep(0.1)
                yield measurement

        asyncio.run(asyncio.wait_for(work(), 10.0))


def test_service_a_refused_stream_says_why_in_asyncio():
    """A vehicle without rights is told so, whether the refusal is there before the measurement or they meet, and as often as it asks."""

    def refuse(_, context):
        context.abort(grpc.StatusCode.PERMISSION_DENIED, "no right")

    async def work(address):
        drive = list(straight("truck", 3))
        async with nesam.AsyncClient(address) as client:
            async with client.measurement_stream() as stream:
                for measurement in drive:
                    await asyncio.sleep(0.1)
                    with pytest.raises(nesam.NesamError, match="no right"):
                        await stream.send(measurement)
            for _ in range(100):
                with pytest.raises(nesam.NesamError, match="no right"):
                    await client.measure(drive * 10)
            for _ in range(20):
                async with client.durable_stream("truck", pause_s=0.01) as stream:
                    with pytest.raises(nesam.NesamError, match="no right"):
                        await stream.send(drive[0])

    with listening(measurements(refuse)) as address:
        asyncio.run(asyncio.wait_for(work(address), 5.0))


def test_service_a_stream_that_ends_midway_is_unavailable_in_both_clients():
    def ends_midway(requests, context):
        for i, request in enumerate(requests):
            if i == 5:
                context.abort(grpc.StatusCode.UNAVAILABLE, "going")
            yield measurements_pb2.MeasurementAnswer(sequence=request.sequence, applied=measurements_pb2.Applied())

    async def work(address):
        async with nesam.AsyncClient(address) as client:
            for _ in range(20):
                with pytest.raises(nesam.Unavailable, match="going"):
                    await client.measure(straight("truck", 300))

    with listening(measurements(ends_midway)) as address, nesam.Client(address) as client:
        asyncio.run(asyncio.wait_for(work(address), 20.0))
        for _ in range(20):
            with pytest.raises(nesam.Unavailable, match="going"):
                client.measure(straight("truck", 300))


def test_service_a_watch_ends_with_its_time():
    """A service that tells something again after half a second, to a client that waits a tenth for its calls."""

    def slowly(message):
        def tell(*_):
            yield message
            time.sleep(0.5)
            yield message

        return grpc.unary_stream_rpc_method_handler(tell, None, lambda message: message.SerializeToString())

    services = (
        ("nesam.v1.Soil", "Watch", slowly(soil_pb2.SoilEstimate(session_id="truck"))),
        ("nesam.v1.Sessions", "WatchAlarms", slowly(alarms_pb2.Alarm(session_id="truck"))),
        ("nesam.v1.Diagnosis", "Start", slowly(diagnosis_pb2.DiagnosisEvent())),
    )

    async def watched(address, watch, timeout_s, told):
        async with nesam.AsyncClient(address, timeout_s=0.1) as client:
            async for one in getattr(client, watch)("truck", timeout_s=timeout_s):
                told.append(one)

    with listening(*services) as address, nesam.Client(address, timeout_s=0.1) as client:
        for watch in ("watch_soil", "alarms", "diagnose"):
            told, told_in_asyncio = [], []
            with pytest.raises(nesam.DeadlineExceeded):
                for one in getattr(client, watch)("truck", timeout_s=0.25):
                    told.append(one)
            with pytest.raises(nesam.DeadlineExceeded):
                asyncio.run(watched(address, watch, 0.25, told_in_asyncio))
            assert len(told) == len(told_in_asyncio) == 1
            asyncio.run(watched(address, watch, None, told_in_asyncio))
            assert len(list(getattr(client, watch)("truck"))) == 2 and len(told_in_asyncio) == 3


def test_service_a_refusal_takes_no_place_away():
    heard = []

    def second_is_refused(requests, _):
        for request in requests:
            heard.append(request.sequence)
            if request.sequence == 1:
                yield measurements_pb2.MeasurementAnswer(place=1, run=5, applied=measurements_pb2.Applied())
            else:
                yield measurements_pb2.MeasurementAnswer(rejected=measurements_pb2.Rejected(code=grpc.StatusCode.PERMISSION_DENIED.value[0]))

    session = sessions_pb2.Session(session_id="truck", run=5, accepted=1, durable_place=1)
    get = grpc.unary_unary_rpc_method_handler(lambda *_: session, None, sessions_pb2.Session.SerializeToString)
    with listening(measurements(second_is_refused), ("nesam.v1.Sessions", "Get", get)) as address, nesam.Client(address) as client:
        first, second = straight("truck", 2)
        with client.durable_stream("truck") as stream:
            stream.send(first)
            assert stream.send(second).outcome == "REJECTED" and [m.sequence for m in stream.pending] == [1]
            stream.flush()
            assert heard == [1, 2] and not stream.pending


@contextmanager
def counted(answers, session):
    """The address of a service whose n-th stream gives the n-th list of answers, (run, place), and whose session is at (run, durable place); and the sequence
    numbers that each stream heard."""
    heard = []

    def stream(requests, _):
        here, newest = [], None
        heard.append(here)
        for (run, place), request in zip(answers[len(heard) - 1], requests):
            here.append(request.sequence)
            outcome = {"duplicate": measurements_pb2.Duplicate()} if place == newest else {"applied": measurements_pb2.Applied()}
            newest = place
            yield measurements_pb2.MeasurementAnswer(place=place, run=run, **outcome)

    told = sessions_pb2.Session(session_id="truck", run=session[0], accepted=session[1], durable_place=session[1])
    get = grpc.unary_unary_rpc_method_handler(lambda *_: told, None, sessions_pb2.Session.SerializeToString)
    with listening(measurements(stream), ("nesam.v1.Sessions", "Get", get)) as address:
        yield address, heard


@contextmanager
def counting(answers, session):
    """A client of such a service."""
    with counted(answers, session) as (address, heard), nesam.Client(address) as client:
        yield client, heard


@pytest.mark.parametrize(
    "answers, session",
    [
        pytest.param([[(5, 1), (5, 2), (6, 9), (6, 9)], [(6, 10), (6, 11), (6, 11), (6, 12)]], (6, 12), id="another run"),
        pytest.param([[(5, 7), (5, 8), (5, 1), (5, 1)], [(5, 2), (5, 3), (5, 3), (5, 4)]], (5, 4), id="a session that began anew"),
    ],
)
def test_service_who_counts_otherwise_midway_is_sent_everything_in_order(answers, session):
    with counting(answers, session) as (client, heard), client.durable_stream("truck", pause_s=0.01) as stream:
        for measurement in straight("truck", 4):
            assert stream.send(measurement).outcome == "APPLIED"
        assert heard == [[1, 2, 3], [1, 2, 3, 4]] and [m.sequence for m in stream.pending] == [1, 2, 3, 4]
        stream.flush()
        assert not stream.pending and len(heard) == 2


def test_service_in_asyncio_who_counts_otherwise_is_sent_everything_in_order():
    """Midway as above, and then the session is at another run, too."""
    answers = [[(5, 1), (5, 2), (6, 9), (6, 9)], [(6, 10), (6, 11), (6, 11)], [(7, 1), (7, 2), (7, 3)]]

    async def work(address):
        async with nesam.AsyncClient(address) as client, client.durable_stream("truck", pause_s=0.01) as stream:
            for measurement in straight("truck", 3):
                await stream.send(measurement)
            await stream.flush()
            assert not stream.pending

    with counted(answers, (7, 3)) as (address, heard):
        asyncio.run(asyncio.wait_for(work(address), 5.0))
        assert heard == [[1, 2, 3], [1, 2, 3], [1, 2, 3]]


def test_service_a_session_at_another_run_is_sent_everything_over_a_new_stream():
    answers = [[(5, 1), (5, 2), (5, 3)], [(6, 9), (6, 10)]]
    with counting(answers, (6, 10)) as (client, heard), client.durable_stream("truck", pause_s=0.01) as stream:
        for measurement in straight("truck", 2):
            stream.send(measurement)
        stream.flush()
        assert heard == [[1, 2], [1, 2]] and not stream.pending


def test_service_what_cannot_be_sent_holds_up_nothing():
    with counting([[(5, 1)]], (5, 1)) as (client, heard), client.durable_stream("truck") as stream:
        with pytest.raises(ValueError, match="state"):
            stream.send(nesam.Measurement("truck", 0, np.zeros(6), (1.0, 0.0)))
        assert not stream.pending
        assert stream.send(next(straight("truck", 1))).outcome == "APPLIED" and heard == [[1]]


def test_service_an_interrupted_send_shifts_no_answers():
    """Method: a signal whose handler raises, as Ctrl-C does, while the service takes its time with the first answer."""
    heard = []

    def slow_at_first(requests, _):
        here = []
        heard.append(here)
        for place, request in enumerate(requests, 1):
            here.append(request.sequence)
            if len(heard) == 1:
                time.sleep(0.5)
            yield measurements_pb2.MeasurementAnswer(sequence=request.sequence, place=place, run=5, applied=measurements_pb2.Applied())

    def interrupt(*_):
        raise KeyboardInterrupt

    first, second = straight("truck", 2)
    with listening(measurements(slow_at_first)) as address, nesam.Client(address) as client, client.durable_stream("truck") as stream:
        before = signal.signal(signal.SIGALRM, interrupt)
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            with pytest.raises(KeyboardInterrupt):
                stream.send(first)
        finally:
            signal.signal(signal.SIGALRM, before)
        assert [m.sequence for m in stream.pending] == [1]
        assert stream.send(second).sequence == 2 and heard == [[1], [1, 2]] and [m.sequence for m in stream.pending] == [1, 2]


@pytest.mark.parametrize("kind", (nesam.Client, nesam.AsyncClient))
def test_property_an_address_is_no_url(kind):
    for address in ("http://127.0.0.1:50051", "https://server:50051"):
        with pytest.raises(ValueError, match="expected host:port"):
            kind(address)


def test_service_a_slow_vehicle_is_not_a_silent_service():
    def slowly():
        for measurement in straight("truck", 4):
            time.sleep(0.4)
            yield measurement

    with listening(measurements(at_once)) as address, nesam.Client(address, timeout_s=0.3) as client:
        assert [answer.sequence for answer in client.measure(slowly())] == [1, 2, 3, 4]
        assert [answer.sequence for answer in client.measure(straight("truck", 2000))] == list(range(1, 2001))
        with pytest.raises(ValueError, match="state"), client.measurement_stream() as stream:
            stream.send(nesam.Measurement("truck", 0, np.zeros(6), (1.0, 0.0)))
