"""Goal: a call that only reads outlives a restart of the server, within its deadline; one that changes something is made once, and so is one that has a fallback.
Method: the real binary, killed and started again; ports that refuse at first; a listener that counts."""

import asyncio
import socket
import threading
import time
from concurrent import futures
from contextlib import contextmanager

import grpc
import numpy as np
import pytest
from conftest import free_port, start_server, straight
from google.protobuf import any_pb2, duration_pb2
from google.rpc import error_details_pb2, status_pb2
from test_client import fan
from test_connection import at_once, listening, measurements

import nesam
from nesam._errors import from_rpc
from nesam.v1 import prediction_pb2, sessions_pb2

CARD = nesam.VehicleCard("cart", "yaw_rate_rad_s", (-1.0, 3.0), (-1.0, 1.0), 1.0, 0.0)


class Blocking:
    """A client of either kind, asked from a test without a loop: `ask(lambda client: client.session("truck"))`."""

    def __init__(self, kind, address, **options):
        self._kind, self._address, self._options = kind, address, options

    def ask(self, *works):
        """The answers or errors of calls over one connection, one after the other, and how long each took, s."""
        if self._kind is nesam.Client:
            with nesam.Client(self._address, **self._options) as client:
                return [_timed(lambda work=work: work(client)) for work in works]
        return asyncio.run(self._in_a_loop(works))

    async def _in_a_loop(self, works):
        async with nesam.AsyncClient(self._address, **self._options) as client:
            told = []
            for work in works:
                begun = time.monotonic()
                try:
                    answer = await work(client)
                except nesam.NesamError as error:
                    answer = error
                told.append((answer, time.monotonic() - begun))
            return told


def _timed(call):
    begun = time.monotonic()
    try:
        answer = call()
    except nesam.NesamError as error:
        answer = error
    return answer, time.monotonic() - begun


KINDS = pytest.mark.parametrize("kind", [nesam.Client, nesam.AsyncClient])


@contextmanager
def refusing(times, code=grpc.StatusCode.UNAVAILABLE):
    """The address of a service that refuses the first calls of each method, and by method the attempts as (number, peer)."""
    heard = {}

    def refuse_first(name, reply):
        def answer(_, context):
            attempts = heard.setdefault(name, [])
            attempts.append((int(dict(context.invocation_metadata()).get("grpc-previous-rpc-attempts", 0)), context.peer()))
            if len(attempts) <= times:
                context.abort(code, "not now")
            return reply

        return grpc.unary_unary_rpc_method_handler(answer, None, lambda message: message.SerializeToString())

    services = (
        ("nesam.v1.Sessions", "Get", refuse_first("Get", sessions_pb2.Session(session_id="truck"))),
        ("nesam.v1.Sessions", "Open", refuse_first("Open", sessions_pb2.Session(session_id="truck"))),
        ("nesam.v1.Sessions", "Close", refuse_first("Close", sessions_pb2.CloseSessionReply())),
        ("nesam.v1.Prediction", "Predict", refuse_first("Predict", prediction_pb2.PredictReply())),
    )
    with listening(*services) as address:
        yield address, heard


@KINDS
def test_service_a_restarted_server_costs_a_reading_call_nothing(request, tmp_path, kind):
    port = free_port()
    arguments = ("--grpc", f"127.0.0.1:{port}", "--no-http", "--no-zenoh", "--store", str(tmp_path / "store"))
    running, starting = [start_server(request, *arguments)[0]], []
    address = f"127.0.0.1:{port}"

    def killed_and_started(work):
        def inside(client):
            for timer in starting:
                timer.join()
            running[-1].kill()
            running[-1].wait()
            starting.append(threading.Timer(0.4, lambda: running.append(start_server(request, *arguments)[0])))
            starting[-1].start()
            return work(client)

        return inside

    try:
        with nesam.Client(address) as client, client.durable_stream("truck") as stream:
            client.open_session("truck")
            for measurement in straight("truck", 20):
                stream.send(measurement)
            stream.flush()
            before = client.predict("truck", fan(3, 8)).states

        told = Blocking(kind, address).ask(
            lambda client: client.session("truck"),
            killed_and_started(lambda client: client.session("truck")),
            killed_and_started(lambda client: client.predict("truck", fan(3, 8))),
        )
        (first, _), (second, second_s), (prediction, third_s) = told
        assert first.accepted == second.accepted == 20 and first.run != second.run
        assert 0.4 < second_s < 4.0 and 0.4 < third_s < 4.0
        np.testing.assert_array_equal(prediction.states, before)
    finally:
        for timer in starting:
            timer.join()
        for process in running:
            process.kill()
            process.wait()


@KINDS
def test_service_a_port_that_refuses_at_first_is_tried_again_and_not_for_ever(kind):
    port = free_port()
    address = f"127.0.0.1:{port}"
    session = sessions_pb2.Session(session_id="truck")
    get = grpc.unary_unary_rpc_method_handler(lambda *_: session, None, sessions_pb2.Session.SerializeToString)
    server = grpc.server(futures.ThreadPoolExecutor(2), options=[("grpc.so_reuseport", 0)])
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("nesam.v1.Sessions", {"Get": get})])

    def listen():
        server.add_insecure_port(address)
        server.start()

    for attempts_max, least_s, most_s in ((5, 1.2, 4.0), (1, 0.0, 0.3)):
        [(refused, seconds)] = Blocking(kind, address, attempts_max=attempts_max).ask(lambda client: client.session("truck"))
        # Five attempts pause for 0.1, 0.25, 0.625 and 1 s, each up to a fifth less.
        assert isinstance(refused, nesam.Unavailable) and least_s < seconds < most_s
    threading.Timer(0.3, listen).start()
    try:
        [(answer, seconds)] = Blocking(kind, address).ask(lambda client: client.session("truck"))
        assert answer.session_id == "truck" and 0.3 < seconds < 4.0
    finally:
        server.stop(None)


@KINDS
def test_service_the_deadline_ends_all_attempts(kind):
    """One server refuses the connection, the other one the call."""
    with socket.socket() as closed, refusing(100) as (address, heard):
        closed.bind(("127.0.0.1", 0))
        for where in (f"127.0.0.1:{closed.getsockname()[1]}", address):
            [(refused, seconds)] = Blocking(kind, where, timeout_s=0.6).ask(lambda client: client.session("truck"))
            assert isinstance(refused, (nesam.Unavailable, nesam.DeadlineExceeded)) and seconds < 0.9
        assert 2 <= len(heard["Get"]) <= 4


@KINDS
def test_service_what_reads_is_tried_again_and_what_changes_something_once(kind):
    with refusing(3) as (address, heard):
        [(session, _), (opened, _), (closed, _)] = Blocking(kind, address).ask(
            lambda client: client.session("truck"), lambda client: client.open_session("truck"), lambda client: client.close_session("truck")
        )
    assert session.session_id == "truck" and [number for number, _ in heard["Get"]] == [0, 1, 2, 3]
    assert isinstance(opened, nesam.Unavailable) and isinstance(closed, nesam.Unavailable)
    assert len(heard["Open"]) == len(heard["Close"]) == 1


@KINDS
def test_service_who_is_overloaded_is_not_asked_again(kind):
    with refusing(1, grpc.StatusCode.RESOURCE_EXHAUSTED) as (address, heard):
        [(refused, _)] = Blocking(kind, address).ask(lambda client: client.session("truck"))
    assert isinstance(refused, nesam.Overloaded) and len(heard["Get"]) == 1


@KINDS
def test_service_the_largest_question_is_tried_again_and_a_fallback_does_not_wait(kind):
    """A question of 2 MB is eight times what gRPC keeps for another attempt by default. Both kinds of prediction go over one connection."""
    large = np.zeros((8192, 32, 2), np.float32)
    with refusing(100) as (address, heard):
        client = Blocking(kind, address, timeout_s=30.0)
        start, fallback = np.zeros(12), nesam.KinematicFallback(CARD)
        [(refused, _), (answer, seconds)] = client.ask(
            lambda client: client.predict("truck", large), lambda client: client.predict("truck", fan(1, 4), start=start, fallback=fallback)
        )
    assert isinstance(refused, nesam.Unavailable) and answer.computed_by == "kinematic_fallback" and seconds < 0.5
    assert [number for number, _ in heard["Predict"]] == [0, 1, 2, 3, 4, 0] and len({peer for _, peer in heard["Predict"]}) == 1


@KINDS
def test_property_attempts_are_counted_from_one_to_five(kind):
    for wrong in (0, 6):
        with pytest.raises(ValueError, match="allowed are 1 to 5"):
            kind("127.0.0.1:1", attempts_max=wrong)


def status_with(code, message, retry_after_s):
    """Trailing metadata of a refusal that says when to come back, as the service writes it."""
    retry = error_details_pb2.RetryInfo(retry_delay=duration_pb2.Duration(seconds=int(retry_after_s), nanos=round(retry_after_s % 1 * 1e9)))
    detail = any_pb2.Any()
    detail.Pack(retry)
    return ("grpc-status-details-bin", status_pb2.Status(code=code.value[0], message=message, details=[detail]).SerializeToString())


@KINDS
def test_service_an_overloaded_service_says_when_it_has_room(request, kind):
    """The real server, asked for more than it can compute in the time that it is given."""
    server, address = start_server(request, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh")
    try:
        with nesam.Client(address, timeout_s=60.0) as client:
            client.open_session("truck")
            client.measure(straight("truck", 20))
            client.predict("truck", fan(64, 32))
            # It knows by now how long a candidate takes; while it is at a large question, another one would be late. On a busy machine that may not be told in time.
            with futures.ThreadPoolExecutor(1) as beside:
                begun, large, refused = time.monotonic(), None, None
                while not isinstance(refused, nesam.Overloaded) and time.monotonic() < begun + 30.0:
                    if large is None or large.done():
                        large = beside.submit(client.predict, "truck", fan(2048, 32))
                    [(refused, _)] = Blocking(kind, address).ask(lambda client: client.predict("truck", fan(2048, 32), timeout_s=0.1))
            assert isinstance(refused, nesam.Overloaded) and 0.0 < refused.retry_after_s < 60.0
            with pytest.raises(nesam.NotFound) as unknown:
                client.session("nobody")
            assert unknown.value.retry_after_s is None
    finally:
        server.terminate()
        assert server.wait(timeout=30) == 0


@KINDS
def test_service_a_durable_stream_comes_back_when_the_service_asks_for_it(kind):
    """The pause of its own would be 5 s."""
    streams = []

    def moves(requests, context):
        streams.append(time.monotonic())
        if len(streams) == 1:
            context.set_trailing_metadata((status_with(grpc.StatusCode.UNAVAILABLE, "moves", 0.3),))
            context.abort(grpc.StatusCode.UNAVAILABLE, "moves")
        yield from at_once(requests, context)

    with listening(measurements(moves)) as address:
        client = Blocking(kind, address)
        [(answer, _)] = client.ask(lambda client: client.durable_stream("truck", pause_s=5.0).send(next(straight("truck", 1))))
        assert answer.outcome == "APPLIED" and 0.28 < streams[1] - streams[0] < 2.0
        streams.clear()
        [(refused, _)] = client.ask(lambda client: client.measure(straight("truck", 1)))
        assert isinstance(refused, nesam.Unavailable) and refused.retry_after_s == pytest.approx(0.3)


def test_property_details_that_are_none_say_nothing():
    class Refused(grpc.RpcError):
        def __init__(self, details):
            self._details = details

        def code(self):
            return grpc.StatusCode.UNAVAILABLE

        def details(self):
            return "away"

        def trailing_metadata(self):
            return (("grpc-status-details-bin", self._details),)

    for details in (b"", b"\xff\xff\xff", b"\x1a\x04\x0a\x02ab", "text"):
        assert from_rpc(Refused(details)).retry_after_s is None
