"""Goal: what other clients send is recorded and comes out bit for bit. Method: the real server records zeros below 0, whose sign messages of some
languages leave out; `nesam replay`."""

import subprocess

import numpy as np
from conftest import start_server

import nesam


def test_service_zeros_below_0_are_replayed(request, tmp_path, hills):
    server, address = start_server(request, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--record", "run", folder=tmp_path)
    with nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(hills)
        client.open_session("truck", map_id="hills")
        for i in range(12):
            state = np.full(12, -0.0)
            state[[0, 2, 6]] = 0.2 * i - 10.0, 0.6, 2.0
            wheels = np.full(4, -0.0)
            assert client.measure([nesam.Measurement("truck", i * 100_000_000, state, (2.0, -0.0), sequence=i + 1, wheel_speed_rad_s=wheels)])[0].place
        start = np.full(12, -0.0)
        start[2] = 0.6
        client.predict("truck", np.tile([2.0, -0.0], (4, 16, 1)))
        client.predict("truck", np.zeros((4, 16, 2)), start=start)
        client.export_session("truck")
    server.terminate()
    assert server.wait(timeout=30) == 0
    bundle = request.config.getoption("--bundle")
    replayed = [request.config.getoption("--server"), "replay", "run", *(["--bundle", bundle] if bundle else [])]
    done = subprocess.run(replayed, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
