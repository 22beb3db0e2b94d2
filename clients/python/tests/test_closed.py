"""Goal: what is closed says so, what was left open costs nothing, and small mistakes are told in plain words. Method: both clients, before and while something is on
its way."""

import asyncio
import gc
import pickle
import threading
import time
import warnings

import grpc
import numpy as np
import pytest
from conftest import straight
from test_client import fan
from test_connection import listening, measurements

import nesam
from nesam.v1 import measurements_pb2, prediction_pb2, soil_pb2

CLOSED = "the client is closed"


def silent(begun):
    """Services that hear a question, tell so, and say nothing."""

    def wait(_, context):
        begun.set()
        over = threading.Event()
        context.add_callback(over.set)
        over.wait(20.0)

    def watch(request, context):
        wait(request, context)
        yield soil_pb2.SoilEstimate()

    predict = grpc.unary_unary_rpc_method_handler(
        lambda request, context: wait(request, context) or prediction_pb2.PredictReply(), None, prediction_pb2.PredictReply.SerializeToString
    )
    return (
        ("nesam.v1.Prediction", "Predict", predict),
        ("nesam.v1.Soil", "Watch", grpc.unary_stream_rpc_method_handler(watch, None, soil_pb2.SoilEstimate.SerializeToString)),
        measurements(lambda requests, context: [wait(one, context) for one in requests] and iter(())),
    )


ASKED = ["predict", "watch", "send", "measure"]


def ask(client, what):
    """In threads."""
    if what == "predict":
        client.predict("truck", fan(1, 1))
    elif what == "watch":
        list(client.watch_soil("truck"))
    elif what == "send":
        with client.measurement_stream() as stream:
            stream.send(next(straight("truck", 1)))
    else:
        client.measure(straight("truck", 2))


async def ask_awaited(client, what):
    """In asyncio."""
    if what == "predict":
        await client.predict("truck", fan(1, 1))
    elif what == "watch":
        async for _ in client.watch_soil("truck"):
            pass
    elif what == "send":
        async with client.measurement_stream() as stream:
            await stream.send(next(straight("truck", 1)))
    else:
        await client.measure(straight("truck", 2))


async def begin_asking(address, what, begun):
    """A client in asyncio and the task in which it asks, once the service has heard the question."""
    client = nesam.AsyncClient(address)
    asking = asyncio.ensure_future(ask_awaited(client, what))
    await asyncio.get_running_loop().run_in_executor(None, begun.wait, 20.0)
    return client, asking


@pytest.mark.parametrize("what", ASKED)
def test_service_a_client_that_is_closed_is_unavailable(what):
    begun = threading.Event()
    with listening(*silent(begun)) as address:
        client = nesam.Client(address)
        told = []

        def asking():
            try:
                ask(client, what)
            except Exception as error:
                told.append(error)

        thread = threading.Thread(target=asking)
        thread.start()
        assert begun.wait(20.0)
        client.close()
        thread.join(20.0)
        assert [(type(error), error.message) for error in told] == [(nesam.Unavailable, CLOSED)]
        with pytest.raises(nesam.Unavailable, match=CLOSED):
            ask(client, what)
        begin = time.monotonic()
        with pytest.raises(nesam.Unavailable, match=CLOSED):
            client.durable_stream("truck").send(next(straight("truck", 1)))
        assert time.monotonic() - begin < 5.0, "it does not come back"


@pytest.mark.parametrize("what", ASKED)
def test_service_a_client_that_is_closed_is_unavailable_in_asyncio(what):
    begun = threading.Event()

    async def work(address):
        client, asking = await begin_asking(address, what, begun)
        await client.close()
        with pytest.raises(nesam.Unavailable, match=CLOSED):
            await asyncio.wait_for(asking, 20.0)
        with pytest.raises(nesam.Unavailable, match=CLOSED):
            await ask_awaited(client, what)
        with pytest.raises(nesam.Unavailable, match=CLOSED):
            await asyncio.wait_for(client.durable_stream("truck").send(next(straight("truck", 1))), 5.0)

    with listening(*silent(begun)) as address:
        asyncio.run(work(address))


@pytest.mark.parametrize("what", ASKED)
def test_service_a_task_that_is_cancelled_is_cancelled_even_if_its_client_closes(what):
    begun = threading.Event()

    async def work(address):
        client, asking = await begin_asking(address, what, begun)
        asking.cancel()
        await client.close()
        with pytest.raises(asyncio.CancelledError):
            await asking

    with listening(*silent(begun)) as address:
        asyncio.run(work(address))


def counting_streams(open_now):
    """A service of measurements that answers, and how many of its streams are open."""

    def answer(requests, context):
        open_now.append(None)
        context.add_callback(open_now.pop)
        for request in requests:
            yield measurements_pb2.MeasurementAnswer(sequence=request.sequence, applied=measurements_pb2.Applied())

    return measurements(answer)


def none_open(open_now):
    """Whether all streams have ended, soon."""
    gc.collect()
    end = time.monotonic() + 20.0
    while open_now and time.monotonic() < end:
        time.sleep(0.01)
    return not open_now


def test_service_streams_that_nobody_closed_end_with_their_objects():
    open_now = []
    with listening(counting_streams(open_now)) as address, nesam.Client(address, timeout_s=20.0) as client:
        with pytest.warns(ResourceWarning, match="was not closed"):
            for measurement in straight("truck", 20):
                client.measurement_stream().send(measurement)
            assert none_open(open_now)

        async def work():
            async with nesam.AsyncClient(address, timeout_s=20.0) as aio:
                for measurement in straight("truck", 20):
                    await aio.measurement_stream().send(measurement)

        with pytest.warns(ResourceWarning, match="was not closed"):
            asyncio.run(work())
            assert none_open(open_now)
        with warnings.catch_warnings():
            warnings.simplefilter("error", ResourceWarning)
            with client.measurement_stream() as stream:
                stream.send(next(straight("truck", 1)))
            del stream
            gc.collect()


def test_regress_errors_travel_between_processes():
    for kind in (nesam.NesamError, nesam.NotFound, nesam.Overloaded):
        error = kind(grpc.StatusCode.NOT_FOUND, "session_id", "it is not there", 0.5)
        copy = pickle.loads(pickle.dumps(error))
        assert type(copy) is kind and str(copy) == str(error)
        assert (copy.code, copy.field, copy.message, copy.retry_after_s) == (error.code, "session_id", "it is not there", 0.5)


@pytest.mark.parametrize("kind", (nesam.Client, nesam.AsyncClient))
def test_property_an_address_has_a_port(kind):
    for address in ("127.0.0.1", "server", "::1", "[::1]", "server:", "server:grpc", ""):
        with pytest.raises(ValueError, match="expected host:port"):
            kind(address)

    async def take():
        for address in ("server:50051", "[::1]:50051", "unix:/tmp/nesam.sock", "dns:///server:50051"):
            taken = kind(address)
            await taken.close() if kind is nesam.AsyncClient else taken.close()

    asyncio.run(take())


def test_service_an_infinite_timeout_is_none(driven, server_address):
    assert driven.predict("truck", fan(1, 2), timeout_s=float("inf")).computed_by == "service"
    with nesam.Client(server_address, timeout_s=float("inf")) as client, client.measurement_stream() as stream:
        assert stream.send(list(straight("truck", 40))[-1]).outcome == "DUPLICATE"

    async def work():
        async with nesam.AsyncClient(server_address, timeout_s=float("inf")) as client:
            return await client.measure(straight("truck", 3)), await client.predict("truck", fan(1, 2))

    answers, prediction = asyncio.run(work())
    assert len(answers) == 3 and prediction.computed_by == "service"


def test_service_a_session_stands_for_its_name(driven, server_address):
    session = driven.session("truck")
    expected = driven.predict("truck", fan(1, 2)).states

    async def work():
        async with nesam.AsyncClient(server_address) as client:
            return (await client.predict(session, fan(1, 2), timeout_s=60.0)).states

    assert (driven.predict(session, fan(1, 2)).states == expected).all() and (asyncio.run(work()) == expected).all()


def test_service_what_holds_arrays_is_equal_to_itself_alone(driven):
    session, prediction = driven.session("truck"), driven.predict("truck", fan(1, 2))
    assert session == session and session != driven.session("truck") and session not in driven.sessions()
    assert prediction == prediction and prediction != driven.predict("truck", fan(1, 2))
    assert nesam.Measurement("s", 0, np.zeros(12), (0.0, 0.0)) != nesam.Measurement("s", 0, np.zeros(12), (0.0, 0.0))
    assert len({session, prediction}) == 2
