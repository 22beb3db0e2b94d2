"""Goal: what a user gives is taken as it is meant, or refused by its name before anything is sent. Method: masked arrays, iterators, and numbers that do not fit."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from conftest import straight
from test_client import fan

import nesam
from nesam import _calls as calls

CARD = nesam.VehicleCard("cart", "yaw_rate_rad_s", (-1.0, 3.0), (-1.0, 1.0), 1.0, 0.0)


def masked(values):
    """`values` with the first number masked, as rasterio and netCDF4 give them: what lies under the mask means nothing."""
    values = np.array(values, dtype=np.float64)
    values.flat[0] = -9999.0
    return np.ma.masked_equal(values, -9999.0)


def test_service_what_is_masked_in_a_map_is_a_hole(client, hills):
    holes = np.zeros(hills.elevation_m.shape, bool)
    holes[40:60, 70:90] = True
    filled = np.where(holes, np.nan, hills.elevation_m)
    hidden = np.ma.array(np.where(holes, -9999.0, hills.elevation_m), mask=holes)
    by_name = {}
    for name, elevation in (("nan", filled), ("masked", hidden), ("whole", hills.elevation_m)):
        by_name[name] = client.upload_map(replace(hills, map_id=name, elevation_m=elevation)).hash
    assert by_name["masked"] == by_name["nan"] != by_name["whole"]
    assert client.patch_tile("whole", 1, 0, 0, hidden).hash == by_name["nan"]
    # Integers have no NaN; a mask that hides nothing is none.
    tile = np.ma.array(np.full((3, 3), -9999), mask=np.ones((3, 3), bool))
    patched = [client.patch_tile(name, 1, 5, 5, one) for name, one in (("nan", tile), ("masked", np.full((3, 3), np.nan)))]
    assert patched[0].hash == patched[1].hash
    assert client.patch_tile("masked", 2, 0, 0, np.ma.array(np.zeros((2, 2)))).version == 3


@pytest.mark.parametrize(
    "name, ask",
    [
        ("controls", lambda c: c.predict("s", masked(fan(1, 2)))),
        ("nominal", lambda c: c.predict("s", nesam.Drawing(masked(np.zeros((2, 2))), 4, (0.1, 0.1)))),
        ("start", lambda c: c.predict("s", fan(1, 2), start=masked(np.zeros(12)))),
        ("path", lambda c: c.predict("s", fan(1, 2), cost=nesam.PathCost(masked(np.zeros((2, 2))), 1.0))),
        ("soil_deltas", lambda c: c.predict("s", fan(1, 2), extras=nesam.Extras(soil_deltas=masked(np.zeros((1, 6)))))),
        ("state", lambda c: c.measure([nesam.Measurement("s", 0, masked(np.zeros(12)), (0.0, 0.0))])),
        ("command", lambda c: c.measure([nesam.Measurement("s", 0, np.zeros(12), masked(np.zeros(2)))])),
        ("wheel_speed_rad_s", lambda c: c.measure([nesam.Measurement("s", 0, np.zeros(12), (0.0, 0.0), wheel_speed_rad_s=masked(np.zeros(4)))])),
        ("semantic_rgb", lambda c: c.patch_tile("m", 1, 0, 0, np.zeros((1, 1)), np.ma.array(np.zeros((1, 1, 3), np.uint8), mask=True))),
    ],
)
def test_property_what_is_masked_elsewhere_is_refused_by_name(name, ask):
    with nesam.Client("127.0.0.1:9", timeout_s=0.2) as client, pytest.raises(ValueError, match=f"^{name} has masked numbers"):
        ask(client)


@pytest.mark.parametrize("name, count", [("wheel_speed_rad_s", 4), ("road_wheel_angle_rad", 2)])
def test_regress_numbers_of_wheels_are_as_many_as_wheels(name, count):
    """A stream would end for 10 000 of them, and a durable one would send them again for ever."""
    with nesam.Client("127.0.0.1:9", timeout_s=0.2) as client:
        for wrong in (np.ones(count + 1), np.ones(10_000), np.ones((count, 1))):
            measurement = nesam.Measurement("s", 0, np.zeros(12), (0.0, 0.0), **{name: wrong})
            with pytest.raises(ValueError, match=f"^{name} has shape"):
                client.measure([measurement])
            stream = client.durable_stream("s")
            with pytest.raises(ValueError, match=f"^{name} has shape"):
                stream.send(measurement)
            assert not stream.pending


def test_service_iterators_are_read_once_for_the_service_and_the_fallback(driven, server_address):
    session = driven.session("truck")
    last = session.last_stamp_ns
    stamps, commands = [last + k * 100_000_000 for k in range(8)], [(3.0, 0.8)] * 8
    sent, fallback = list(zip(stamps, commands)), nesam.KinematicFallback(session.vehicle)
    expected = driven.predict("truck", fan(1, 4), start_stamp_ns=last + 500_000_000, sent=sent)
    # What the client knows begins there now.
    begun = driven.predict("truck", fan(1, 4), start_stamp_ns=last + 800_000_000, sent=sent, fallback=fallback, timeout_s=0.0)

    async def awaited():
        async with nesam.AsyncClient(server_address) as client:
            given = {"fallback": fallback, "sent": zip(stamps, commands), "channels": iter("xy")}
            first = await client.predict("truck", fan(1, 4), start_stamp_ns=last + 500_000_000, timeout_s=60.0, **given)
            given = {"fallback": fallback, "sent": zip(stamps, commands), "channels": iter("xy")}
            return first, await client.predict("truck", fan(1, 4), start_stamp_ns=last + 800_000_000, timeout_s=0.0, **given)

    def asked(after_ns, timeout_s):
        given = {"fallback": fallback, "sent": zip(stamps, commands), "channels": (name for name in "xy")}
        return driven.predict("truck", fan(1, 4), start_stamp_ns=last + after_ns, timeout_s=timeout_s, **given)

    for first, late in ((asked(500_000_000, 60.0), asked(800_000_000, 0.0)), asyncio.run(awaited())):
        assert first.computed_by == "service" and first.channels == ("x", "y")
        np.testing.assert_array_equal(first.states, expected.states[:, :, :2])
        assert late.computed_by == "kinematic_fallback" and late.rolled_forward_steps == 5 + 3 and late.channels == ("x", "y")
        np.testing.assert_array_equal(late.start, begun.start)
        assert late.start[6] == 3.0, "the commands were heeded"


@pytest.mark.parametrize(
    "name, given, ask",
    [
        ("stride", "-1", lambda c, v: c.predict("s", fan(1, 2), stride=-1)),
        ("stride", "1.5", lambda c, v: c.predict("s", fan(1, 2), stride=1.5)),
        ("samples_min", "-1", lambda c, v: c.predict("s", fan(1, 2), samples_min=-1)),
        ("start_stamp_ns", str(2**63), lambda c, v: c.predict("s", fan(1, 2), start_stamp_ns=2**63)),
        ("samples", "-4", lambda c, v: c.predict("s", nesam.Drawing(np.zeros((2, 2)), -4, (0.1, 0.1)))),
        ("seed", "-1", lambda c, v: c.predict("s", nesam.Drawing(np.zeros((2, 2)), 4, (0.1, 0.1), seed=-1))),
        ("best", "-1", lambda c, v: c.predict("s", fan(1, 2), cost=nesam.PathCost(np.zeros((2, 2)), 1.0, best=-1))),
        ("row", "-1", lambda c, v: c.patch_tile("m", 1, -1, 0, np.zeros((1, 1)))),
        ("column", "-2", lambda c, v: c.patch_tile("m", 1, 0, -2, np.zeros((1, 1)))),
        ("base_version", "-1", lambda c, v: c.patch_tile("m", -1, 0, 0, np.zeros((1, 1)))),
        ("version", "-1", lambda c, v: c.upload_map(nesam.WorldMap("m", np.zeros((2, 2)), 1.0, version=-1))),
        ("sequence", "-1", lambda c, v: c.measure([v(sequence=-1)])),
        ("boot_id", "-1", lambda c, v: c.measure([v(boot_id=-1)])),
        ("stamp_ns", "1.5", lambda c, v: c.measure([v(stamp_ns=1.5)])),
        ("seed", "-3", lambda c, v: next(c.diagnose("s", seed=-3))),
    ],
)
def test_property_a_number_that_does_not_fit_is_named_with_what_is_allowed(name, given, ask):
    def measurement(**changed):
        return replace(next(straight("s", 1)), **changed)

    with nesam.Client("127.0.0.1:9", timeout_s=0.2) as client, pytest.raises(ValueError, match=f"^{name} is {given}, allowed are whole numbers from "):
        ask(client, measurement)


@pytest.mark.parametrize("sent", [[(5, (1.0,))], [(5, 1.0, 0.0)], [(5, (1.0, "x"))], [7], np.zeros((1, 3))])
def test_property_a_command_that_is_none_is_named(sent):
    with nesam.Client("127.0.0.1:9", timeout_s=0.2) as client, pytest.raises(ValueError, match=r"^sent\[0\] is .*expected \(stamp_ns, \(speed, second\)\)"):
        client.predict("s", fan(1, 2), start_stamp_ns=9, sent=sent)
    with pytest.raises(ValueError, match=r"^sent\[1\].stamp_ns is 0.5"):
        calls.Question("s", fan(1, 2), start_stamp_ns=9, sent=[(0, (0.0, 0.0)), (0.5, (0.0, 0.0))])


def test_service_a_tile_that_is_too_large_says_how_it_goes(client, server_address):
    # 4.5 MB with colours.
    elevation, rgb = np.zeros((801, 801), np.float32), np.zeros((801, 801, 3), np.uint8)
    client.upload_map(nesam.WorldMap("wide", elevation, 0.1, semantic_rgb=rgb))

    async def awaited():
        async with nesam.AsyncClient(server_address, timeout_s=60.0) as aio:
            await aio.patch_tile("wide", 1, 0, 0, elevation, rgb)

    for patch in (lambda: client.patch_tile("wide", 1, 0, 0, elevation, rgb), lambda: asyncio.run(awaited())):
        with pytest.raises(nesam.InvalidArgument, match=r"801 x 801 cells.* 4194304 bytes .*tile_bytes_max.*one part after the other.*higher version") as refused:
            patch()
        assert refused.value.field == "elevation_m"
    assert client.patch_tile("wide", 1, 0, 0, elevation[:500], rgb[:500]).version == 2
    assert client.upload_map(nesam.WorldMap("wide", elevation, 0.1, semantic_rgb=rgb, version=3)).version == 3


@pytest.mark.parametrize("kind", [nesam.Client, nesam.AsyncClient])
def test_property_a_vehicle_that_is_no_name_is_refused(kind):
    async def opened(vehicle_id):
        return kind("127.0.0.1:1", vehicle_id=vehicle_id)

    for wrong in ("truck-7\n", "Björn", "a b", "x" * 65):
        with pytest.raises(ValueError, match="vehicle_id"):
            asyncio.run(opened(wrong))
    asyncio.run(opened("truck-7"))
