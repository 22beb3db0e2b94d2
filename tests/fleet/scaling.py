"""tests/fleet/run --scaling: what sessions and queries cost a replica, and whether more replicas change that. The inputs of docs/capacity.md.

The load is a fixed amount for each replica, so that two cores bear three of them; what is compared is processor time for the same work."""

import os
import time
from pathlib import Path

import numpy as np

import nesam
import traffic
from services import REPLICAS

VEHICLES = 2
"""For each replica."""
SECONDS = 12.9
RATE_HZ = 10.0
CONTROLS = np.stack(np.broadcast_arrays(np.linspace(1.0, 3.0, 64)[:, None], np.linspace(-0.3, 0.3, 32)), axis=-1).astype(np.float32)
MEMORY_SESSIONS = (100, 600)
MEMORY_STEPS = 40


def processor_s(process):
    """Processor time of a process so far, s."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_bytes(process, field="VmRSS"):
    """Memory of a process that is resident now: all of it, or the part that a field of /proc/PID/status counts."""
    for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"no {field}")


class Timed(traffic.Planner):
    """A planner that keeps its times."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.took_s = []

    def run(self):
        while not self._ending.wait(self._every_s):
            begun = time.monotonic()
            try:
                self.client.predict(self._session, CONTROLS)
                self.took_s.append(time.monotonic() - begun)
            except nesam.FailedPrecondition:
                pass


class Reading:
    """Counters of all processes at one instant."""

    def __init__(self, fleet, replicas):
        self.at = time.monotonic()
        self.server_s = sum(processor_s(fleet.processes[name]) for name in replicas)
        self.etcd_s = processor_s(fleet.processes["etcd"])
        self.proxy_s = processor_s(fleet.processes["proxy"])
        self.commits = sum(fleet.metric(name, "nesam_store_commits_total") for name in replicas)
        self.bytes = sum(fleet.metric(name, "nesam_store_bytes_total") for name in replicas)


def phase(fleet, replicas, name, plan, vehicles=VEHICLES):
    """Vehicles drive, with or without planners: figures for each measurement, commit and query."""
    sessions = [f"{name}-{i}" for i in range(vehicles * len(replicas))]
    drivers = [traffic.Vehicle(fleet.proxy_address, session, steps=int(SECONDS * RATE_HZ), rate_hz=RATE_HZ) for session in sessions]
    planners = [Timed(fleet.proxy_address, session, every_s=1.0) for session in sessions] if plan else []
    before = Reading(fleet, replicas)
    traffic.start(drivers, planners)
    for vehicle in drivers:
        vehicle.join()
    for planner in planners:
        planner.stop()
    after = Reading(fleet, replicas)
    traffic.close(drivers, planners)
    measurements = sum(len(vehicle.steps) for vehicle in drivers)
    took = sorted(time_s for planner in planners for time_s in planner.took_s)
    return {
        "server_s": after.server_s - before.server_s,
        "etcd_s": after.etcd_s - before.etcd_s,
        "proxy_s": after.proxy_s - before.proxy_s,
        "commits": after.commits - before.commits,
        "bytes": after.bytes - before.bytes,
        "measurements": measurements,
        "queries": len(took),
        "took_s": took,
    }


def memory(fleet):
    """Prints the memory of a session: what the second part of many sessions adds to that of the first."""
    process = fleet.processes[REPLICAS[0]]
    resident = []
    with nesam.Client(f"{fleet.hosts.address[REPLICAS[0]]}:50051", timeout_s=60.0) as client:
        for first, last in ((0, MEMORY_SESSIONS[0]), MEMORY_SESSIONS):
            for i in range(first, last):
                client.open_session(f"memory-{i}", map_id=traffic.MAP)
                client.measure(traffic.drive(f"memory-{i}")[:MEMORY_STEPS])
                client.predict(f"memory-{i}", traffic.CONTROLS)
            resident.append(resident_bytes(process))
    each = (resident[1] - resident[0]) / (MEMORY_SESSIONS[1] - MEMORY_SESSIONS[0])
    print(f"{MEMORY_SESSIONS[0]} sessions {resident[0] / 1e6:.0f} MB, {MEMORY_SESSIONS[1]} sessions {resident[1] / 1e6:.0f} MB: {each / 1e3:.0f} kB each, with {MEMORY_STEPS} measurements and a prediction")


def measure(fleet):
    """Prints the table. The fleet runs; replicas that are not needed are ended first."""
    print(f"{VEHICLES} vehicles a replica at {RATE_HZ:.0f} Hz for {SECONDS:.0f} s, a query of 64 x 32 a second each; processor time in ms")
    print(f"{'replicas':>8} {'measurement':>12} {'query':>8} {'p50 ms':>8} {'p99 ms':>8} {'etcd a vehicle s':>17} {'proxy a message':>16} {'kB a vehicle s':>15}")
    # Terrain is encoded once for each map and server; that is not what is measured.
    phase(fleet, REPLICAS, "warm", plan=True, vehicles=6)
    for count in (3, 2, 1):
        replicas = REPLICAS[:count]
        for name in REPLICAS[count:]:
            if fleet.processes[name].running:
                fleet.processes[name].terminate()
        time.sleep(2.0)
        quiet = phase(fleet, replicas, f"quiet{count}", plan=False)
        busy = phase(fleet, replicas, f"busy{count}", plan=True)
        each_s = quiet["server_s"] / quiet["measurements"]
        query_s = (busy["server_s"] - each_s * busy["measurements"]) / busy["queries"]
        vehicle_s = VEHICLES * count * SECONDS
        took = busy["took_s"]
        print(
            f"{count:>8} {1e3 * each_s:>12.2f} {1e3 * query_s:>8.1f} {1e3 * took[len(took) // 2]:>8.0f} {1e3 * took[int(0.99 * len(took))]:>8.0f}"
            f" {1e3 * quiet['etcd_s'] / vehicle_s:>17.2f} {1e3 * quiet['proxy_s'] / quiet['measurements']:>16.3f} {quiet['bytes'] / vehicle_s / 1e3:>15.1f}",
            flush=True,
        )
