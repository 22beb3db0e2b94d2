"""Goal: asyncio gets what threads get. Method: both clients ask the same server."""

import asyncio

import numpy as np
import pytest

import nesam
from conftest import straight
from test_client import fan


def run(address, work):
    """Runs `await work(client)` with an asyncio client."""

    async def inside():
        async with nesam.AsyncClient(address, timeout_s=60.0) as client:
            return await work(client)

    return asyncio.run(inside())


def test_service_both_clients_hear_the_same(driven, server_address):
    async def work(client):
        drawing = nesam.Drawing(fan(1, 6)[0], samples=4, sd=(0.3, 0.1), seed=1)
        # Asked at the same time over one connection.
        several = await asyncio.gather(*(client.predict("truck", fan(n, 8), wheel_sinkage=True) for n in (1, 2, 3)))
        drawn = await client.predict("truck", drawing)
        return several, drawn, await client.session("truck"), await client.sessions(), await client.maps()

    several, drawn, session, sessions, maps = run(server_address, work)
    for n, prediction in enumerate(several, start=1):
        same = driven.predict("truck", fan(n, 8), wheel_sinkage=True)
        assert (prediction.states == same.states).all() and (prediction.sinkage_m == same.sinkage_m).all()
    assert (driven.predict("truck", drawn.controls).states == drawn.states).all()
    assert session.history_steps == 32 and [s.session_id for s in sessions] == ["truck"] and maps == driven.maps()


def test_service_a_drive_in_asyncio(client, server_address, hills):
    async def work(aio):
        await aio.upload_map(hills)
        await aio.open_session("truck", map_id="hills")
        async with aio.measurement_stream() as stream:
            answers = [await stream.send(measurement) for measurement in straight("truck", 20)]
            fork = await aio.fork_session("truck", "copy")
            again = await stream.send(list(straight("truck", 20))[-1])
        with pytest.raises(nesam.Unavailable):
            await stream.send(next(straight("truck", 1)))
        image = await aio.export_session("truck")
        await aio.close_session("truck")
        await aio.import_session(image)
        patched = await aio.patch_tile("hills", 1, 0, 0, np.zeros((2, 2)))
        return answers, fork, again, await aio.predict("truck", fan(2, 4)), patched, await aio.map("hills")

    answers, fork, again, prediction, patched, described = run(server_address, work)
    # A straight line over hills is no drive: the soil filter may refuse a buffer of it, which is accepted all the same.
    assert len(answers) == 20 and {a.outcome for a in answers} <= {"APPLIED", "GATED"} and again.outcome == "DUPLICATE"
    assert fork.session_id == "copy" and prediction.states.shape == (2, 4, 12)
    assert patched.version == 2 and described == patched
    assert (client.predict("truck", fan(2, 4)).start == prediction.start).all()


@pytest.mark.parametrize("in_turns", [False, True], ids=["at hand", "as they come"])
def test_service_measurements_are_answered_in_order(client, server_address, in_turns):
    client.open_session("truck")
    drive = list(straight("truck", 300))
    expected = client.measure(drive)
    client.close_session("truck")
    client.open_session("truck")

    async def as_they_come():
        for i, measurement in enumerate(drive):
            if i % 100 == 50:
                # Longer than the client waits for an answer.
                await asyncio.sleep(0.6)
            yield measurement

    async def work():
        async with nesam.AsyncClient(server_address, timeout_s=0.5) as aio:
            assert await aio.measure([]) == []
            answers = await aio.measure(as_they_come() if in_turns else drive)
            with pytest.raises(ValueError, match="state"):
                await aio.measure([drive[0], nesam.Measurement("truck", 0, np.zeros(6), (1.0, 0.0))])
            bad = await aio.measure([nesam.Measurement("nobody", 0, np.zeros(12), (1.0, 0.0))])
            fallback = nesam.KinematicFallback((await aio.session("truck")).vehicle)
            return answers, bad, await aio.predict("truck", fan(1, 4), timeout_s=-1.0, fallback=fallback)

    answers, [bad], late = asyncio.run(work())
    assert [(a.sequence, a.outcome, a.place) for a in answers] == [(a.sequence, a.outcome, a.place) for a in expected]
    assert bad.outcome == "REJECTED"
    # What was measured is where the fallback begins.
    np.testing.assert_array_equal(late.start, drive[-1].state)


def test_service_refusals_are_typed_and_a_late_answer_falls_back(driven, server_address):
    fallback = nesam.KinematicFallback(driven.session("truck").vehicle)

    async def work(client):
        with pytest.raises(nesam.NotFound):
            await client.session("nobody")
        with pytest.raises(nesam.InvalidArgument) as refused:
            await client.predict("truck", fan(1, 33))
        assert refused.value.field == "horizon"
        with pytest.raises(nesam.NotFound):
            async for _ in client.alarms("nobody"):
                pass
        with pytest.raises((nesam.DeadlineExceeded, nesam.Overloaded)):
            await client.predict("truck", fan(2000, 32), timeout_s=0.004)
        await client.predict("truck", fan(1, 1))
        return await client.predict("truck", fan(2000, 32), timeout_s=0.004, fallback=fallback, stride=8)

    late = run(server_address, work)
    assert late.computed_by == "kinematic_fallback" and late.states.shape == (2000, 4, 12)


def test_service_an_active_alarm_or_none_is_told_until_the_session_closes(driven, server_address):
    async def work(client):
        async def watch():
            return [alarm async for alarm in client.alarms("truck")]

        watching = asyncio.create_task(watch())
        await asyncio.sleep(0.3)
        await client.close_session("truck")
        return await asyncio.wait_for(watching, 20)

    told = run(server_address, work)
    assert len(told) <= 1 and all(alarm.active and alarm.session_id == "truck" for alarm in told)


def test_regress_nobody_there_is_unavailable():
    async def work(client):
        with pytest.raises(nesam.Unavailable):
            await client.sessions()

    run("127.0.0.1:9", work)
