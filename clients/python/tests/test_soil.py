"""What is learned of the soil, told as it comes and by place; two real servers that tell each other."""

import asyncio
import time

import numpy as np
import pytest
from conftest import free_port, start_server, straight

import nesam

CONFIG = """
[http]
enabled = false
[zenoh]
enabled = true
mode = "{mode}"
listen = [{listen}]
connect = [{connect}]
name = "{name}"
[fleet_soil]
enabled = true
exchange_s = 1.0
"""


@pytest.fixture
def two_servers(request, tmp_path):
    """Addresses of two servers of one fleet; the first one is the other one's router."""
    endpoint = f'"tcp/127.0.0.1:{free_port()}"'
    first = CONFIG.format(mode="router", listen=endpoint, connect="", name="alpha")
    second = CONFIG.format(mode="client", listen="", connect=endpoint, name="beta")
    running = []
    for name, text in (("alpha", first), ("beta", second)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "nesam.toml").write_text(text)
        running.append(start_server(request, "--config", "nesam.toml", "--grpc", "127.0.0.1:0", folder=folder))
    yield [address for _, address in running]
    for process, _ in reversed(running):
        process.terminate()
        assert process.wait(timeout=30) == 0


def all_alike(cells, others):
    """Whether two servers know the same of the same cells."""

    def alike(here, there):
        same_place = here.cell == there.cell and (here.colour_rgb == there.colour_rgb).all()
        return same_place and np.allclose(here.information, there.information, rtol=1e-3) and np.allclose(here.vector, there.vector, rtol=1e-3)

    return len(cells) == len(others) and all(map(alike, cells, others))


def test_service_servers_tell_each_other_what_their_vehicles_learn_of_the_ground(two_servers, hills):
    with nesam.Client(two_servers[0], timeout_s=60.0) as alpha, nesam.Client(two_servers[1], timeout_s=60.0) as beta:
        for client in (alpha, beta):
            client.upload_map(hills)
            assert client.fleet_soil().cells == []
        alpha.open_session("truck", map_id="hills")
        answers = alpha.measure(straight("truck", 90))
        assert sum(answer.outcome == "APPLIED" for answer in answers) > 45
        # One prediction has come true: from the 32nd step, 32 steps ahead.
        forecasts = alpha.session("truck").forecasts
        assert forecasts.checked == 1 and forecasts.error_rms_m.shape == forecasts.expected_rms_m.shape == (3,)
        assert (forecasts.error_rms_m > 0.0).all() and (forecasts.expected_rms_m > 0.0).all() and min(forecasts.scale, forecasts.height_scale) >= 0.5
        assert beta.sessions() == []
        brought = alpha.fleet_soil("hills")
        assert brought.cells and brought.cell_m == 10.0
        for cell in brought.cells:
            assert cell.map_id == "hills" and cell.colour_rgb.shape == (3,) and cell.buffers > 0.0 and 0.0 <= cell.age_s < 60.0
            assert cell.information.shape == (6, 6) and np.allclose(cell.information, cell.information.T) and cell.vector.shape == (6,)
            # Cells of 10 m along x from -10 to 8 m, on y = 0.
            assert cell.cell[0] in (-1, 0) and cell.cell[1] in (-1, 0)
        # A cell is told each time that it changes: the last time is what was brought.
        deadline = time.monotonic() + 20.0
        while not all_alike(brought.cells, beta.fleet_soil().cells):
            assert time.monotonic() < deadline, "the other server has not heard of it"
            time.sleep(0.05)
        assert beta.fleet_soil("elsewhere").cells == []
        # A vehicle that begins there knows it from its first measurement on.
        beta.open_session("lorry", map_id="hills")
        beta.measure(straight("lorry", 1))
        assert beta.session("lorry").provenance.soil_epoch == 1


def test_service_the_soil_is_watched_until_the_session_closes(driven, server_address):
    with pytest.raises(nesam.FailedPrecondition):
        driven.fleet_soil()
    with pytest.raises(nesam.NotFound):
        next(driven.watch_soil("nobody"))
    first = next(driven.watch_soil("truck"))
    assert first.session_id == "truck" and first.soil.delta.shape == (6,)
    assert (first.stamp_ns is None) == (first.soil_epoch == 0)
    provenance = driven.session("truck").provenance
    assert (first.history_epoch, first.map_version, first.bundle_hash) == (provenance.history_epoch, 1, provenance.bundle_hash)

    async def watched():
        async with nesam.AsyncClient(server_address, timeout_s=60.0) as client:
            with pytest.raises(nesam.FailedPrecondition):
                await client.fleet_soil()
            told = []

            async def watch():
                async for estimate in client.watch_soil("truck"):
                    told.append(estimate)

            watching = asyncio.create_task(watch())
            while not told:
                await asyncio.sleep(0.01)
            await client.close_session("truck")
            await asyncio.wait_for(watching, 20)
            return told

    told = asyncio.run(watched())
    assert told[0].soil_epoch == first.soil_epoch and (told[0].soil.delta == first.soil.delta).all()
