"""Goal: a vehicle that keeps what is not durable loses nothing when the server is killed or stands still, and does not wait for it for ever; where nothing
becomes durable it keeps so much and no more. Method: the real binary, SIGKILL and a restart on its store, SIGSTOP and SIGCONT, no store."""

import asyncio
import os
import signal
import threading
import time
from dataclasses import replace

import grpc
import numpy as np
import pytest

import nesam
from conftest import free_port, start_server, straight


@pytest.fixture
def start(request, tmp_path):
    """Starts a server on one port and one store, again and again."""
    port, running = free_port(), []

    def started():
        process, address = start_server(request, "--grpc", f"127.0.0.1:{port}", "--no-http", "--no-zenoh", "--store", str(tmp_path / "store"))
        running.append(process)
        return process, address

    yield started
    for process in running:
        process.kill()
        process.wait()


def test_service_a_killed_server_costs_nothing(start, hills):
    drive = list(straight("truck", 60))
    process, address = start()
    with nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(hills)
        client.open_session("truck", map_id="hills")
        with client.durable_stream("truck") as stream:
            for measurement in drive[:33]:
                assert stream.send(measurement).outcome in ("APPLIED", "GATED")
                if measurement is drive[19]:
                    stream.flush()
            process.kill()
            process.wait()
            pending = len(stream.pending)
            assert 0 < pending < 33, "some are durable and some are not"
            restarter = threading.Timer(0.5, start)
            restarter.start()
            for measurement in drive[33:]:
                answer = stream.send(measurement)
            restarter.join()
            assert answer.outcome in ("APPLIED", "GATED") and answer.history_epoch == 60
            stream.flush()
            assert not stream.pending
        session = client.session("truck")
        assert session.accepted == session.durable_place == 60 and session.last_sequence == 60
        np.testing.assert_array_equal(session.state, drive[-1].state)
        # The same drive without a crash gives the same soil, bit for bit.
        client.open_session("truck", session_id="other", map_id="hills")
        client.measure(nesam.Measurement("other", m.stamp_ns, m.state, m.command, m.sequence) for m in drive)
        other = client.session("other")
        np.testing.assert_array_equal(session.soil.delta, other.soil.delta)
        np.testing.assert_array_equal(session.soil.covariance, other.soil.covariance)


def test_service_a_server_that_stands_still_is_given_up_and_loses_nothing(start, hills):
    drive = list(straight("truck", 30))
    process, address = start()
    with nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(hills)
        client.open_session("truck", map_id="hills")
        with client.durable_stream("truck", reconnect_s=1.5) as stream:
            for measurement in drive[:10]:
                stream.send(measurement)
            process.send_signal(signal.SIGSTOP)
            os.waitpid(process.pid, os.WUNTRACED)
            begun = time.monotonic()
            with pytest.raises(nesam.Unavailable):
                stream.send(drive[10])
            assert 1.4 < time.monotonic() - begun < 3.0
            begun = time.monotonic()
            with pytest.raises(nesam.DeadlineExceeded):
                stream.flush(timeout_s=0.5)
            assert time.monotonic() - begun < 2.0 and stream.pending[-1].sequence == 11
            process.send_signal(signal.SIGCONT)
            stream.flush()
            for measurement in drive[11:]:
                assert stream.send(measurement).outcome in ("APPLIED", "GATED")
            stream.flush()
            assert not stream.pending
        session = client.session("truck")
        assert session.accepted == session.durable_place == 30 and session.last_sequence == 30
        np.testing.assert_array_equal(session.state, drive[-1].state)


def test_service_in_asyncio_neither_a_kill_nor_a_cancelled_send_costs_anything(start, hills):
    """The first half as `test_service_a_killed_server_costs_nothing`; then one send is cancelled while the server stands still, and two tasks send at once."""
    drive = list(straight("truck", 60))
    process, address = start()

    async def work():
        async with nesam.AsyncClient(address, timeout_s=60.0) as client:
            await client.upload_map(hills)
            await client.open_session("truck", map_id="hills")
            async with client.durable_stream("truck", pause_s=0.05) as stream:
                for measurement in drive[:20]:
                    assert (await stream.send(measurement)).outcome in ("APPLIED", "GATED")
                await stream.flush()
                for measurement in drive[20:33]:
                    await stream.send(measurement)
                process.kill()
                process.wait()
                assert 0 < len(stream.pending) < 33, "some are durable and some are not"
                starting = asyncio.get_running_loop().run_in_executor(None, start)
                for measurement in drive[33:40]:
                    answer = await stream.send(measurement)
                second, _ = await starting
                assert answer.outcome in ("APPLIED", "GATED") and answer.history_epoch == 40

                second.send_signal(signal.SIGSTOP)
                os.waitpid(second.pid, os.WUNTRACED)
                with pytest.raises(asyncio.TimeoutError):
                    await asyncio.wait_for(stream.send(drive[40]), 0.3)
                assert stream.pending[-1].sequence == 41
                begun = time.monotonic()
                with pytest.raises(nesam.DeadlineExceeded):
                    await stream.flush(timeout_s=0.5)
                assert time.monotonic() - begun < 2.0
                second.send_signal(signal.SIGCONT)

                await asyncio.gather(*(stream.send(measurement) for measurement in drive[41:]), stream.flush())
                await stream.flush()
                assert not stream.pending
            session = await client.session("truck")
            assert session.accepted == session.durable_place == 60 and session.last_sequence == 60
            await client.open_session("other", map_id="hills")
            await client.measure(nesam.Measurement("other", m.stamp_ns, m.state, m.command, m.sequence) for m in drive)
            other = await client.session("other")
            np.testing.assert_array_equal(session.state, drive[-1].state)
            np.testing.assert_array_equal(session.soil.delta, other.soil.delta)
            np.testing.assert_array_equal(session.soil.covariance, other.soil.covariance)

    asyncio.run(asyncio.wait_for(work(), 60.0))


def test_service_in_asyncio_so_many_are_kept_and_no_more(client, server_address):
    drive = list(straight("truck", 12))
    client.open_session("truck")

    async def work():
        async with nesam.AsyncClient(server_address) as aio, aio.durable_stream("truck", pending_max=10) as stream:
            for measurement in drive[:10]:
                assert (await stream.send(measurement)).durable_place == 0
            with pytest.raises(nesam.Overloaded) as refused:
                await stream.send(drive[10])
            assert refused.value.field == "pending_max"
            with pytest.raises(nesam.DeadlineExceeded):
                await stream.flush(timeout_s=0.2)
            with pytest.raises(ValueError, match="session `other`"):
                await aio.durable_stream("truck").send(next(straight("other", 1)))
            return [m.sequence for m in stream.pending]

    assert asyncio.run(work()) == list(range(1, 11)) and client.session("truck").accepted == 10


def test_service_in_asyncio_nobody_there_is_given_up():
    async def work():
        async with nesam.AsyncClient(f"127.0.0.1:{free_port()}") as client, client.durable_stream("truck", reconnect_s=0.5) as stream:
            begun = time.monotonic()
            with pytest.raises(nesam.Unavailable):
                await stream.send(next(straight("truck", 1)))
            assert 0.4 < time.monotonic() - begun < 2.0 and len(stream.pending) == 1

    asyncio.run(work())


def test_service_what_is_sent_again_is_never_new(client, hills):
    """However many are kept, and however slowly they come again: more stamps than a session remembers, at the pace of a clock that was set back."""
    client.upload_map(hills)
    client.open_session("again", map_id="hills")
    with client.durable_stream("again") as stream:
        for measurement in straight("again", 320, speed_m_s=0.5):
            stream.send(replace(measurement, sequence=0))
        kept = stream.pending
    assert len(kept) == 320 and kept[0].boot_id and [m.sequence for m in kept] == list(range(1, 321))
    before = client.session("again")
    with client.measurement_stream() as stream:
        for measurement in kept[:10]:
            assert stream.send(measurement).outcome == "DUPLICATE"
            time.sleep(0.1)
    after = client.session("again")
    assert (after.accepted, after.last_stamp_ns) == (before.accepted, before.last_stamp_ns) == (320, kept[-1].stamp_ns)
    np.testing.assert_array_equal(after.state, before.state)


@pytest.mark.parametrize("change", ["clock", "boot"])
def test_service_a_clock_that_is_set_or_a_new_boot_loses_nothing(client, change):
    """What was accepted before is kept until it is durable, over as many connections as it takes; the server keeps no store, so all of it is."""
    hour_ns = 3_600_000_000_000 if change == "clock" else 0
    drive = [replace(m, sequence=0) for m in straight(change, 22)]
    drive = [*drive[:10], *(replace(m, stamp_ns=m.stamp_ns + hour_ns) for m in drive[10:])]
    if change == "boot":
        drive = [replace(m, boot_id=7 + (i >= 10)) for i, m in enumerate(drive)]
    client.open_session(change)
    with client.durable_stream(change) as stream:
        outcomes = [stream.send(measurement).outcome for measurement in drive[:20]]
        assert outcomes[10:12] == (["FUTURE", "CLOCK_JUMP"] if change == "clock" else ["RESTARTED", "APPLIED"])
        accepted = 19 if change == "clock" else 20
        assert len(stream.pending) == client.session(change).accepted == accepted
        for more in (20, 21):
            stream.close()
            assert stream.send(drive[more]).outcome == "APPLIED"
            accepted += 1
            assert len(stream.pending) == client.session(change).accepted == accepted


def test_service_a_new_boot_loses_nothing_in_a_crash(request, tmp_path):
    """The same with a store that does not write in time, and a server that is killed."""
    (tmp_path / "nesam.toml").write_text("[store]\ninterval_s = 60.0\n")
    options = ("--grpc", f"127.0.0.1:{free_port()}", "--no-http", "--no-zenoh", "--store", "store", "--config", "nesam.toml")
    process, address = start_server(request, *options, folder=tmp_path)
    try:
        with nesam.Client(address, timeout_s=60.0) as client:
            client.open_session("truck")
            drive = [replace(m, sequence=0, boot_id=7 + (i >= 10)) for i, m in enumerate(straight("truck", 22))]
            with client.durable_stream("truck") as stream:
                for measurement in drive[:20]:
                    stream.send(measurement)
                stream.close()
                stream.send(drive[20])
                process.kill()
                process.wait()
                process, _ = start_server(request, *options, folder=tmp_path)
                stream.send(drive[21])
                assert client.session("truck").accepted == 22 and client.session("truck").last_stamp_ns == drive[-1].stamp_ns
    finally:
        process.kill()
        process.wait()


def test_service_what_is_kept_is_what_was_sent(start, hills):
    """The vehicle writes its next state into the array of the last one; the server dies before that is durable."""
    process, address = start()
    state = np.zeros(12)
    state[2] = 0.6
    with nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(hills)
        client.open_session("truck", map_id="hills")
        with client.durable_stream("truck") as stream:
            for i in range(5):
                state[0] = 0.1 * i
                stream.send(nesam.Measurement("truck", i * 100_000_000, state, (1.0, 0.0)))
            state[0] = 3.0
            process.kill()
            process.wait()
            start()
            stream.flush()
            assert client.session("truck").state[0] == pytest.approx(0.4)
            for wrong, what in (("other", "session `other`"), ("truck", "begin at 1")):
                with pytest.raises(ValueError, match=what):
                    stream.send(nesam.Measurement(wrong, 10**9, state, (1.0, 0.0), sequence=7))


def test_service_a_planner_lives_on_its_fallback_while_the_server_is_away(start):
    """For longer than a state is one to begin at; the vehicle gives the stream less time than lies between two measurements, as the README says."""
    drive = list(straight("truck", 70))
    process, address = start()
    with nesam.Client(address, timeout_s=60.0) as client, client.durable_stream("truck", reconnect_s=0.05) as stream:
        fallback = nesam.KinematicFallback(client.open_session("truck").vehicle)
        by, restarter = [], threading.Timer(4.5, start)
        for i, measurement in enumerate(drive):
            begun = time.monotonic()
            if i == 10:
                process.kill()
                process.wait()
                restarter.start()
            try:
                stream.send(measurement)
            except nesam.Unavailable:
                pass
            prediction = client.predict("truck", np.full((4, 8, 2), (2.0, 0.0)), timeout_s=0.05, fallback=fallback)
            by.append(prediction.computed_by)
            if prediction.computed_by != "service":
                np.testing.assert_array_equal(prediction.start, measurement.state)
            time.sleep(max(0.0, begun + 0.1 - time.monotonic()))
        restarter.join()
        assert by.count("kinematic_fallback") >= 35
        stream.flush()
        session = client.session("truck")
        assert session.accepted == session.durable_place == session.last_sequence == 70


def test_service_without_a_store_so_many_are_kept_and_no_more(client, hills):
    drive = list(straight("truck", 12))
    client.upload_map(hills)
    client.open_session("truck", map_id="hills")
    with client.durable_stream("truck", pending_max=10) as stream:
        for measurement in drive[:10]:
            assert stream.send(measurement).durable_place == 0
        for measurement in drive[10:]:
            with pytest.raises(nesam.Overloaded, match="10 measurements") as refused:
                stream.send(measurement)
            assert refused.value.code == grpc.StatusCode.RESOURCE_EXHAUSTED and refused.value.field == "pending_max"
        with pytest.raises(nesam.DeadlineExceeded):
            stream.flush(timeout_s=0.2)
        assert [(m.stamp_ns, m.sequence) for m in stream.pending] == [(m.stamp_ns, m.sequence) for m in drive[:10]]
    assert len(stream.pending) == 10 and client.session("truck").accepted == 10


def test_service_what_is_durable_makes_room(start, hills):
    drive = list(straight("truck", 30))
    _, address = start()
    with nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(hills)
        client.open_session("truck", map_id="hills")
        with client.durable_stream("truck", pending_max=3) as stream:
            refused = 0
            for measurement in drive:
                while True:
                    try:
                        assert stream.send(measurement).outcome in ("APPLIED", "GATED")
                        break
                    except nesam.Overloaded:
                        refused += 1
                        stream.flush()
                assert len(stream.pending) <= 3
            stream.flush()
            assert not stream.pending and refused > 0
        session = client.session("truck")
        assert session.accepted == session.durable_place == 30 and session.last_sequence == 30
