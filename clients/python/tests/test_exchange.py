"""Goal: a vehicle that goes on and on sends each measurement when it has it and hears of each answer when it comes, with bounded memory, and loses no answer that
came where the connection breaks. Method: both clients, a real server, and services that answer late, a few or never."""

import asyncio
import queue
import threading
import time

import numpy as np
import pytest
from conftest import straight
from test_connection import at_once, listening, measurements, never
from test_known_states import AWAY, begun_at, gone_after

import nesam
from nesam._stream import ON_THE_WAY_MAX


class Threads:
    """Takes the answers of `Client.exchange`."""

    @staticmethod
    def run(address, given, taken, timeout_s=20.0):
        with nesam.Client(address, timeout_s=timeout_s) as client:
            for answer in client.exchange(given):
                if taken(answer):
                    break


class Tasks:
    """Takes those of `AsyncClient.exchange`; what is given blocks, so another thread waits for it."""

    @staticmethod
    async def _awaited(given):
        loop, given = asyncio.get_running_loop(), iter(given)
        while (measurement := await loop.run_in_executor(None, next, given, None)) is not None:
            yield measurement

    @classmethod
    def run(cls, address, given, taken, timeout_s=20.0):
        async def work():
            async with nesam.AsyncClient(address, timeout_s=timeout_s) as client:
                answers = client.exchange(cls._awaited(given))
                async for answer in answers:
                    if taken(answer):
                        break
                await answers.aclose()

        asyncio.run(work())


both = pytest.mark.parametrize("kind", [Threads, Tasks], ids=["threads", "tasks"])


@both
def test_service_each_answer_comes_before_the_next_measurement_is_there(server_address, client, kind):
    client.open_session("truck")
    heard = queue.SimpleQueue()

    def one_after_the_other():
        for i, measurement in enumerate(straight("truck", 12)):
            if i == 6:
                client.close_session("truck")
            yield measurement
            # Nothing else is sent meanwhile.
            assert heard.get(timeout=10.0) == ("APPLIED" if i < 6 else "REJECTED"), i

    kind.run(server_address, one_after_the_other(), lambda answer: heard.put(answer.outcome))
    assert heard.empty()


@both
def test_service_what_was_answered_is_told_before_the_connection_broke(kind):
    told = []
    with listening(gone_after(5)) as address, pytest.raises(nesam.Unavailable, match="going"):
        kind.run(address, straight("truck", 40), lambda answer: told.append(answer.sequence))
    assert told == [1, 2, 3, 4, 5]


@both
def test_service_what_the_iterable_raises_comes_after_the_answers(kind):
    told = []

    def fails(error):
        yield from straight("truck", 3)
        raise error

    with listening(measurements(at_once)) as address:
        with pytest.raises(OSError, match="the sensor"):
            kind.run(address, fails(OSError("the sensor")), lambda answer: told.append(answer.sequence))
        wrong = nesam.Measurement("truck", 0, np.zeros(6), (1.0, 0.0))
        with pytest.raises(ValueError, match="state"):
            kind.run(address, [*straight("truck", 3), wrong], lambda answer: told.append(answer.sequence))
    assert told == [1, 2, 3, 1, 2, 3]


@both
def test_service_no_answer_in_time_ends_it(kind):
    begun = time.monotonic()
    with listening(measurements(never)) as address, pytest.raises(nesam.DeadlineExceeded):
        kind.run(address, straight("truck", 3), lambda _: None, timeout_s=0.3)
    assert time.monotonic() - begun < 5.0


@both
def test_service_so_many_are_on_their_way_and_no_more(kind):
    given, release = [], threading.Event()

    def held(requests, _):
        for request in requests:
            release.wait(20.0)
            yield from at_once([request], None)

    def endless():
        for measurement in straight("truck", 3 * ON_THE_WAY_MAX):
            given.append(measurement)
            yield measurement

    def release_later():
        end = time.monotonic() + 20.0
        while len(given) <= ON_THE_WAY_MAX and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.2)
        most.append(len(given))
        release.set()

    most, told = [], []
    releasing = threading.Thread(target=release_later)
    with listening(measurements(held)) as address:
        releasing.start()
        kind.run(address, endless(), lambda answer: told.append(answer.sequence))
    releasing.join()
    # One more has been taken from the iterable and waits.
    assert most == [ON_THE_WAY_MAX + 1] and told == list(range(1, 3 * ON_THE_WAY_MAX + 1))


@both
def test_service_who_leaves_the_loop_ends_the_sending(kind):
    given = []

    def slow():
        for measurement in straight("truck", 1000):
            given.append(measurement)
            yield measurement
            time.sleep(0.02)

    with listening(measurements(at_once)) as address:
        kind.run(address, slow(), lambda answer: answer.sequence == 3)
        time.sleep(0.2)
        so_many = len(given)
        time.sleep(0.2)
    assert len(given) == so_many < 500


def test_service_a_fallback_follows_what_is_on_its_way():
    drive = list(straight("truck", 4))
    with listening(measurements(never), AWAY) as address, nesam.Client(address, timeout_s=0.2) as client:
        with pytest.raises(nesam.DeadlineExceeded):
            list(client.exchange(drive))
        assert begun_at(client) == drive[-1].state[0]
