"""Starts the real server and drives a session up to an instant."""

import contextlib
import os
import subprocess
import threading
from pathlib import Path
from typing import Iterator, Tuple

import nesam
import numpy as np

from drives import Drive, World
from rollout import Scene

SESSION, STEP_NS = "yardstick", 100_000_000


@contextlib.contextmanager
def server(binary: str, bundle: str, bf16: bool = False) -> Iterator[Tuple[nesam.Client, int]]:
    """A client of a server of its own on a free loopback port, and the server's process id."""
    command = [binary, "serve", "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--bundle", bundle, *(["--bf16"] if bf16 else [])]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        address = None
        for line in process.stdout:
            words = line.split()
            if words[:1] == ["grpc"]:
                address = words[1]
            if words[:1] == ["ready;"]:
                break
        if address is None:
            raise RuntimeError(f"{' '.join(command)} did not start")
        threading.Thread(target=process.stdout.read, daemon=True).start()
        with nesam.Client(address, timeout_s=120.0) as client:
            yield client, process.pid
    finally:
        process.terminate()
        process.wait(timeout=30)


def drive_until(client: nesam.Client, drive: Drive, world: World, index: int) -> Scene:
    """Uploads the map, sends the measurements up to row `index`, and returns what the session now stands on; 31 rows precede the start."""
    client.upload_map(nesam.WorldMap(world.name, world.elevation_m, world.resolution_m, world.origin_m, world.rgb))
    client.open_session(SESSION, map_id=world.name)
    sent = [nesam.Measurement(SESSION, i * STEP_NS, drive.states[i], drive.commands[i], sequence=i + 1) for i in range(index + 1)]
    answers = client.measure(sent)
    refused = [a for a in answers if a.outcome not in ("APPLIED", "GATED")]
    if refused:
        raise RuntimeError(f"the server did not take measurement {refused[0].sequence}: {refused[0].outcome} {refused[0].message}")
    probe = client.predict(SESSION, drive.commands[None, index : index + 1].astype(np.float32))
    if probe.history_steps != 31 or not np.array_equal(probe.start, drive.states[index]):
        raise RuntimeError("the session does not stand where the drive does")
    if probe.soil_correction.coordinates != "logarithmic":
        raise RuntimeError("the soil correction is not in logarithmic coordinates")
    rows = slice(index - 31, index)
    return Scene(drive.states[rows], drive.commands[rows], drive.states[index], probe.soil_correction.delta)


def processor_s(pid: int) -> float:
    """Processor time of all threads of a process so far, s (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def candidates(drive: Drive, index: int, samples: int, horizon: int, seed: int) -> np.ndarray:
    """Command sequences (samples, horizon, 2) f32 around what the driver did, with time-correlated noise; the first is the driver's own."""
    rng = np.random.default_rng(seed)
    own = drive.commands[index : index + horizon]
    noise = np.zeros((samples, horizon, 2))
    for k in range(horizon):
        before = noise[:, k - 1] if k else 0.0
        noise[:, k] = 0.8 * before + rng.normal(0.0, [0.15, 0.09], (samples, 2))
    noise[0] = 0.0
    controls = own + noise
    controls[..., 0] = controls[..., 0].clip(1.0, 4.0)
    controls[..., 1] = controls[..., 1].clip(-1.0, 1.0)
    return controls.astype(np.float32)
