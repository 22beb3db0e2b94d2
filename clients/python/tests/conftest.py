"""A real server for the tests: `pytest --server path/to/nesam`, or the environment variable NESAM_SERVER."""

import os
import socket
import subprocess
import threading

import numpy as np
import pytest

import nesam


def pytest_addoption(parser):
    parser.addoption("--server", default=os.environ.get("NESAM_SERVER"), help="the nesam binary")
    parser.addoption("--bundle", default=None, help="bundle folder; default: the shipped one")


@pytest.fixture(scope="session")
def server_address(request):
    """Starts `nesam serve` on a free port and gives its address."""
    if not request.config.getoption("--server"):
        pytest.exit("give the server binary: pytest --server path/to/nesam", returncode=2)
    process, address = start_server(request, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh")
    yield address
    process.terminate()
    assert process.wait(timeout=30) == 0, "the server did not shut down cleanly"


def start_server(request, *arguments, folder=None):
    """`nesam serve` with these arguments in a folder, when it is ready: the process and the address of gRPC."""
    bundle = request.config.getoption("--bundle")
    command = [request.config.getoption("--server"), "serve", *arguments, *(["--bundle", bundle] if bundle else [])]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder)
    watchdog = threading.Timer(120.0, process.kill)
    watchdog.start()
    address = None
    for line in process.stdout:
        words = line.split()
        if words[:1] == ["grpc"]:
            address = words[1]
        if words[:1] == ["ready;"]:
            break
    watchdog.cancel()
    assert address, f"{command} did not start"
    # The server may write more; nobody reads it, so the pipe is drained.
    threading.Thread(target=process.stdout.read, daemon=True).start()
    return process, address


def free_port():
    """A port of loopback that nobody uses at the moment."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


@pytest.fixture
def client(server_address):
    with nesam.Client(server_address, timeout_s=60.0) as connected:
        yield connected
        for session in connected.sessions():
            connected.close_session(session.session_id)
        for world in connected.maps():
            connected.delete_map(world.map_id)


@pytest.fixture
def hills():
    """A map of 40 x 30 m at 0.25 m with gentle hills and two colours."""
    y, x = np.mgrid[0:121, 0:161] * 0.25
    rgb = np.where((x > 20)[..., None], np.uint8([90, 140, 60]), np.uint8([200, 180, 120]))
    elevation = (0.4 * np.sin(x / 6) * np.cos(y / 5)).astype(np.float32)
    return nesam.WorldMap("hills", elevation, 0.25, origin_m=(-20.0, -15.0), semantic_rgb=rgb)


def straight(session_id, steps, speed_m_s=2.0):
    """Measurements of a vehicle on a straight line, 10 Hz."""
    for i in range(steps):
        state = np.zeros(12)
        state[0], state[2], state[6] = 0.1 * speed_m_s * i - 10.0, 0.6, speed_m_s
        yield nesam.Measurement(session_id, i * 100_000_000, state, (speed_m_s, 0.0), sequence=i + 1)


@pytest.fixture
def driven(client, hills):
    """A client with a session "truck" on the hills that has driven 40 steps."""
    client.upload_map(hills)
    client.open_session("truck", map_id="hills")
    answers = client.measure(straight("truck", 40))
    # The soil filter may gate a buffer of this made-up drive; its measurements still enter the history.
    assert len(answers) == 40 and {a.outcome for a in answers} <= {"APPLIED", "GATED"}
    return client
