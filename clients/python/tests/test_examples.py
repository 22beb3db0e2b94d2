"""Goal: whoever tries an example is told how to call it and what is missing, and ctrl-c leaves nothing behind. Method: each as its own process, without a server, beside
one, and interrupted. That they do what they are for is tested elsewhere (test_client.py, test_zenoh.py, crates/navigation/tests/plants.rs)."""

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import free_port, start_server

import nesam

CLIENTS = Path(__file__).resolve().parents[2]
PLANNER, PLANT, PUBLISHER, ASKER = (
    CLIENTS / name
    for name in ("examples/planner.py", "python/examples/plant_stub.py", "python/examples/zenoh_publisher.py", "python/examples/zenoh_planner.py")
)
pytestmark = pytest.mark.skipif(not PLANNER.is_file(), reason="the examples are in the repository")


def ran(example, *arguments):
    """How an example ends by itself. That of Zenoh is left out where that is not installed."""
    if example in (PUBLISHER, ASKER):
        pytest.importorskip("zenoh")
    return subprocess.run([sys.executable, example, *arguments], capture_output=True, text=True, timeout=60)


def interrupted(example, *arguments, until):
    """The same after ctrl-c, when it has said this on its standard output or is there for this (a function)."""
    process = subprocess.Popen([sys.executable, "-u", example, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        if callable(until):
            deadline = time.monotonic() + 30.0
            while not until():
                assert process.poll() is None and time.monotonic() < deadline, process.communicate(timeout=1.0)
                time.sleep(0.05)
        else:
            assert until in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=30.0)
    finally:
        process.kill()
        process.wait()
    return subprocess.CompletedProcess(process.args, process.returncode, out, error)


@pytest.mark.parametrize("example", (PLANNER, PLANT, PUBLISHER, ASKER), ids=lambda example: example.stem)
def test_service_an_example_says_how_it_is_called(example):
    told = ran(example, "--help")
    assert told.returncode == 0 and told.stdout.startswith("usage: ") and not told.stderr, told
    assert ran(example, "--nothing-like-it").returncode == 2


def test_service_an_example_says_what_is_missing():
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        wrong = [
            (PLANNER, f"127.0.0.1:{port}", "UNAVAILABLE"),
            (PLANT, f"127.0.0.1:{taken.getsockname()[1]}", "in use"),
            (PLANT, "nowhere", "cannot listen on nowhere"),
        ]
        for example, address, why in wrong:
            told = ran(example, address)
            assert told.returncode == 1 and told.stderr.startswith("error: ") and why in told.stderr and "Traceback" not in told.stderr, told
    told = ran(PLANNER, f"http://127.0.0.1:{port}")
    assert told.returncode == 2 and "expected host:port" in told.stderr and "Traceback" not in told.stderr, told
    for example in (PUBLISHER, ASKER):
        told = ran(example, "--connect", f"tcp/127.0.0.1:{port}")
        assert told.returncode == 1 and "error: tcp/127.0.0.1" in told.stderr and "Traceback" not in told.stderr, told


def test_service_ctrl_c_ends_an_example_and_its_session(request, server_address):
    told = interrupted(PLANNER, server_address, until="t  0.0 s")
    assert told.returncode == 130 and "Traceback" not in told.stderr, told
    with nesam.Client(server_address) as client:
        assert "planner-example" not in [session.session_id for session in client.sessions()]
    port = free_port()

    def listens():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            try:
                taken.bind(("127.0.0.1", port))
            except OSError:
                return True
        return False

    told = interrupted(PLANT, f"127.0.0.1:{port}", until=listens)
    assert told.returncode == 0 and "Traceback" not in told.stderr, told


def test_service_ctrl_c_takes_a_vehicle_out_of_the_network(request, tmp_path):
    pytest.importorskip("zenoh")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = tmp_path / "router.toml"
    config.write_text(f'[zenoh]\nmode = "router"\nlisten = ["{endpoint}"]\nfleet = "python"\nname = "router"\n')
    process, address = start_server(request, "--config", str(config), "--grpc", "127.0.0.1:0", "--no-http")
    try:
        with nesam.Client(address) as client:
            client.open_session("truck-1")
            reports = ("--connect", endpoint, "--fleet", "python", "--seconds", "60")
            told = interrupted(PUBLISHER, *reports, until=lambda: client.session("truck-1").accepted > 10)
            assert told.returncode == 130 and "Traceback" not in told.stderr, told
            told = interrupted(ASKER, *reports, "--cycle", "1", until="leads to")
            assert told.returncode == 130 and "Traceback" not in told.stderr, told
            deadline = time.monotonic() + 20.0
            while client.session("truck-1").vehicle_alive:
                assert time.monotonic() < deadline
                time.sleep(0.05)
    finally:
        process.terminate()
        assert process.wait(timeout=30) == 0
