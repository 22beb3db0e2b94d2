"""The examples zenoh_publisher.py and zenoh_planner.py against a real server that is the Zenoh router of its network."""

import importlib.util
import json
import os
import queue
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import nesam
from conftest import free_port, start_server, straight
from nesam.v1 import prediction_pb2, types_pb2

zenoh = pytest.importorskip("zenoh")

EXAMPLE, PLANNER = (Path(__file__).resolve().parent.parent / "examples" / name for name in ("zenoh_publisher.py", "zenoh_planner.py"))
FLEET_PAGE = Path(__file__).resolve().parents[3] / "docs" / "run-a-fleet.md"
STEP_NS = 100_000_000


@pytest.fixture
def network(request, tmp_path):
    """A server in router mode: its gRPC client and the endpoint of the router."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = tmp_path / "router.toml"
    config.write_text(f'[zenoh]\nmode = "router"\nlisten = ["{endpoint}"]\nfleet = "python"\nname = "router"\n')
    process, address = start_server(request, "--config", str(config), "--grpc", "127.0.0.1:0", "--no-http")
    with nesam.Client(address, timeout_s=60.0) as client:
        yield client, endpoint
    process.terminate()
    assert process.wait(timeout=30) == 0, "the server did not shut down cleanly"


def load_example(path=EXAMPLE):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def until(holds, what):
    deadline = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def test_service_the_example_runs_as_it_stands(network):
    client, endpoint = network
    client.open_session("truck-7")
    command = [sys.executable, str(EXAMPLE), "--connect", endpoint, "--fleet", "python", "--vehicle", "truck-7", "--rate", "50", "--seconds", "3"]
    printed = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert printed.returncode == 0, printed
    counts = dict(zip(printed.stdout.split()[::2], map(int, printed.stdout.split()[1::2])))
    # On a busy machine the publisher itself may pause for longer than a step and a half.
    again = counts.pop("DUPLICATE", 0)
    assert set(counts) <= {"APPLIED", "BUFFERED", "GAP"} and sum(counts.values()) == 150 and counts["APPLIED"] >= 15, (counts, again)
    session = client.session("truck-7")
    assert session.last_sequence == 150 and session.boot_id


def test_service_reordering_repetition_gap_and_restart_over_zenoh(network):
    client, endpoint = network
    client.open_session("truck-8")
    assert client.session("truck-8").vehicle_alive is False
    example, answers = load_example(), queue.Queue()
    vehicle = example.ZenohVehicle(endpoint, "python", "truck-8", answers.put)
    until(vehicle.heard, "nobody listens")
    until(lambda: client.session("truck-8").vehicle_alive, "the token was not seen")

    def exchange(measurement):
        answer = answers.get(timeout=20.0)
        assert (answer.sequence, answer.stamp_ns) == (measurement.sequence, measurement.stamp_ns)
        return answer.WhichOneof("outcome").upper(), answer.reordered

    sent = []
    for i in range(6):
        sent.append(vehicle.publish(i * STEP_NS, *example.measured(0.1 * i)))
        assert exchange(sent[-1]) == ("APPLIED", False)
    vehicle.send(sent[5])
    assert exchange(sent[5]) == ("DUPLICATE", False)
    # Number 7 is held back on its way and arrives after number 8.
    vehicle.send = lambda measurement: None
    held = vehicle.publish(6 * STEP_NS, *example.measured(0.6))
    del vehicle.send
    later = vehicle.publish(7 * STEP_NS, *example.measured(0.7))
    assert exchange(later) == ("GAP", False)
    vehicle.send(held)
    assert exchange(held) == ("APPLIED", True)
    assert client.session("truck-8").history_steps == 8
    vehicle.close()
    until(lambda: not client.session("truck-8").vehicle_alive, "the token stayed")

    again = example.ZenohVehicle(endpoint, "python", "truck-8", answers.put)
    until(again.heard, "nobody listens")
    # Stamps that begin again are believed the second time.
    assert exchange(again.publish(0, *example.measured(0.8))) == ("TOO_OLD", False)
    assert exchange(again.publish(STEP_NS, *example.measured(0.9))) == ("RESTARTED", False)
    assert exchange(again.publish(2 * STEP_NS, *example.measured(1.0))) == ("APPLIED", False)
    again.send(later)
    assert exchange(later) == ("TOO_OLD", False)
    session = client.session("truck-8")
    assert (session.history_steps, session.last_sequence) == (2, 3)
    np.testing.assert_allclose(session.state, example.measured(1.0)[0])
    again.close()


def store_and_router(request, folder, endpoint, grpc):
    config = folder / "router.toml"
    config.write_text(f'[zenoh]\nmode = "router"\nlisten = ["{endpoint}"]\nfleet = "python"\nname = "router"\n')
    return start_server(request, "--config", str(config), "--grpc", grpc, "--no-http", "--store", str(folder / "store"))


def test_service_what_a_killed_server_did_not_keep_is_sent_again_before_what_is_newer(request, tmp_path):
    """The example goes on while the server is killed and away for longer than a silence, and again for less."""
    endpoint, grpc = f"tcp/127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
    process, _ = store_and_router(request, tmp_path, endpoint, grpc)
    command = [sys.executable, str(EXAMPLE), "--connect", endpoint, "--fleet", "python", "--vehicle", "truck-6", "--rate", "20", "--seconds", "8"]
    with nesam.Client(grpc, timeout_s=60.0) as client:
        client.open_session("truck-6")
        vehicle = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            for accepted, away_s in ((30, 1.5), (90, 0.0)):
                until(lambda: client.session("truck-6").accepted >= accepted, "measurements come")
                process.kill()
                process.wait()
                time.sleep(away_s)
                process, _ = store_and_router(request, tmp_path, endpoint, grpc)
            out, error = vehicle.communicate(timeout=60.0)
        finally:
            vehicle.kill()
            vehicle.wait()
        counts = dict(zip(out.split()[::2], map(int, out.split()[1::2])))
        assert vehicle.returncode == 0 and not {"TOO_OLD", "GAP"} & set(counts), (out, error)
        session = client.session("truck-6")
        assert (session.accepted, session.last_sequence, session.history_steps) == (160, 160, 32), out
    process.terminate()
    assert process.wait(timeout=30) == 0


def test_service_the_planner_asks_over_zenoh(network):
    client, endpoint = network
    client.open_session("truck-5")
    client.measure(straight("truck-5", 40))
    asks = [sys.executable, str(PLANNER), "--connect", endpoint, "--fleet", "python", "--vehicle", "truck-5", "--cycle", "1", "--seconds", "3"]
    printed = subprocess.run(asks, capture_output=True, text=True, timeout=60)
    assert printed.returncode == 0 and printed.stdout.count("second command +0.50 leads to") == 3, printed

    example = load_example(PLANNER)
    planner = example.ZenohPlanner(endpoint, "python", "truck-5")
    controls = example.candidates(samples=8, horizon=20)
    expected = client.predict("truck-5", controls)
    np.testing.assert_array_equal(example.states_of(planner.predict(controls, 10.0)), expected.states)
    # From now, with what is on its way.
    last = client.session("truck-5").last_stamp_ns
    sent = [(last, (2.0, 0.1)), (last + STEP_NS, (2.0, 0.3))]
    messages = [prediction_pb2.SentCommand(stamp_ns=stamp, command=types_pb2.Control(speed_m_s=one[0], second=one[1])) for stamp, one in sent]
    now = planner.predict(controls, 10.0, start_stamp_ns=last + 2 * STEP_NS, sent=messages)
    expected = client.predict("truck-5", controls, start_stamp_ns=last + 2 * STEP_NS, sent=sent)
    np.testing.assert_array_equal(example.states_of(now), expected.states)
    assert now.rolled_forward_steps == 2

    with pytest.raises(example.Refused, match="admits") as refused:
        planner.predict(controls * (1.0, 1e3), 10.0)
    assert refused.value.code == 3 and refused.value.field.startswith("controls[")
    planner.close()
    for vehicle, fleet, error in (("truck-4", "python", example.Refused), ("truck-5", "other", TimeoutError)):
        planner = example.ZenohPlanner(endpoint, fleet, vehicle)
        with pytest.raises(error) as told:
            planner.predict(controls, 1.0)
        assert fleet == "other" or (told.value.code, told.value.field) == (5, "session_id")
        planner.close()
    asks[asks.index("truck-5")] = "truck-4"
    printed = subprocess.run(asks, capture_output=True, text=True, timeout=60)
    assert printed.returncode == 1 and printed.stderr.count("no answer in cycle") == 3 and "Traceback" not in printed.stderr, printed


@pytest.mark.skipif(not FLEET_PAGE.is_file(), reason="the book is in the repository")
def test_service_the_fleet_of_the_book_keeps_to_its_own_keys(request, tmp_path, monkeypatch):
    server = Path(request.config.getoption("--server")).resolve()
    block = re.search(r"<!-- run -->\n```sh\n(.*?)```", FLEET_PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
    environment = {**os.environ, "REPO": str(FLEET_PAGE.parents[1]), "PATH": f"{server.parent}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-euo", "pipefail", "-c", block], cwd=tmp_path, env=environment, check=True, stdout=subprocess.DEVNULL)
    endpoint = f"tls/localhost:{free_port()}"
    (tmp_path / "nesam.toml").write_text((tmp_path / "nesam.toml").read_text().replace("tls/localhost:7447", endpoint))
    # The router of the book, on a free port; its files are named as seen from this folder.
    text = (tmp_path / "router.json5").read_text().replace("tls/0.0.0.0:7447", endpoint)
    for name in ("router.pem", "router.key", "fleet-ca.pem"):
        text = text.replace(f'"{name}"', json.dumps(str(tmp_path / name)))
    router = zenoh.open(zenoh.Config.from_json5(text))
    process, address = start_server(request, "--config", "nesam.toml", "--grpc", "127.0.0.1:0", "--no-http", folder=tmp_path)

    def tls(name):
        return (tmp_path / "fleet-ca.pem", tmp_path / f"{name}.pem", tmp_path / f"{name}.key")

    try:
        example, answers, overheard = load_example(), queue.Queue(), queue.Queue()
        shown = nesam.Tls.from_files(*tls("truck-7"), server_name="localhost")
        with nesam.Client(address, timeout_s=60.0, tls=shown) as client:
            client.open_session("truck-7")
            own = example.ZenohVehicle(endpoint, "default", "truck-7", answers.put, tls("truck-7"))
            planner = example.ZenohVehicle(endpoint, "default", "truck-7", overheard.put, tls("mission-1"))
            other = example.ZenohVehicle(endpoint, "default", "truck-8", overheard.put, tls("truck-7"))
            until(own.heard, "the service listens")
            state, command = example.measured(0.0)
            for liar in (planner, other):
                liar.publish(0, state, command)
            own.publish(STEP_NS, state, command)
            assert answers.get(timeout=20).WhichOneof("outcome") == "applied"
            # The planner may hear what its vehicle is told, and only that.
            assert overheard.get(timeout=20).sequence == 1
            time.sleep(1.0)
            assert answers.empty() and overheard.empty()
            assert client.session("truck-7").accepted == 1
            # The planner of the page, as it is written there.
            connects = re.search(r"```python\n(.*?)```", FLEET_PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
            monkeypatch.chdir(tmp_path)
            planner_names = {"nesam": nesam}
            exec(connects.replace("server:50051", address.replace("127.0.0.1", "localhost")), planner_names)
            with planner_names["client"] as asks:
                assert asks.session("truck-7").accepted == 1
            for vehicle in (own, planner, other):
                vehicle.close()
    finally:
        process.terminate()
        router.close()
    assert process.wait(timeout=30) == 0
