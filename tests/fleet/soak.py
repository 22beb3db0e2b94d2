"""tests/fleet/run --soak SECONDS: whether memory, files and threads of every process stay what they are under load that comes and goes.

Vehicles over gRPC and Zenoh with planners drive, end their sessions and begin new ones, again and again. Sampled every ten seconds; the first third is for
warming up. Holds when a straight line through the rest rises by no more than the allowance in the time that was watched. Every sample is written to soak.csv in
the folder of the run: memory of its own (anonymous), of files and shared."""

import csv
import os
import time
from pathlib import Path

import numpy as np

import nesam
import traffic
from scaling import resident_bytes
from services import REPLICAS

VEHICLES, ZENOH_VEHICLES = 4, 1
SAMPLE_S = 10.0
MEMORY_GROWTH = 0.05
"""Allowed, as a share of the memory in the middle."""
COUNT_GROWTH = 3.0
"""Allowed, in files and in threads."""


def sample(process):
    """Memory in MB (all that is resident, anonymous, of files, shared), open files, threads."""
    folder = Path(f"/proc/{process.pid}")
    parts = [resident_bytes(process, field) / 1e6 for field in ("VmRSS", "RssAnon", "RssFile", "RssShmem")]
    return *parts, len(os.listdir(folder / "fd")), len(os.listdir(folder / "task"))


def keep(samples, file):
    """Writes all samples."""
    with open(file, "w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(("process", "time_s", "resident_mb", "anonymous_mb", "file_mb", "shared_mb", "files", "threads"))
        for name, rows in samples.items():
            writer.writerows((name, *(f"{value:.3f}" for value in row)) for row in rows)


def one_round(fleet, number, violations):
    """Some vehicles drive their drive; at its end their sessions are closed. Gives the number of answers."""
    router = f"tcp/{fleet.hosts.address['router']}:7447"
    names = [f"soak-{number}-{i}" for i in range(VEHICLES)]
    vehicles = [traffic.ZenohVehicle(fleet.proxy_address, name, router, "fleet") for name in names[:ZENOH_VEHICLES]]
    vehicles += [traffic.Vehicle(fleet.proxy_address, name) for name in names[ZENOH_VEHICLES:]]
    planners = [traffic.Planner(fleet.proxy_address, name, every_s=0.5) for name in names]
    traffic.start(vehicles, planners)
    for vehicle in vehicles:
        vehicle.join()
    for planner in planners:
        planner.stop()
    for thread in (*vehicles, *planners):
        violations += thread.violations
    traffic.close(vehicles, planners)
    return sum(planner.answered for planner in planners) + sum(len(vehicle.steps) for vehicle in vehicles)


def soak(fleet, seconds):
    """Prints a table; gives what did not hold."""
    watched = {name: fleet.processes[name] for name in (*REPLICAS, "etcd", "proxy")}
    samples, violations, begun, rounds, answers, last = {name: [] for name in watched}, [], time.monotonic(), 0, 0, 0.0
    while (now := time.monotonic() - begun) < seconds:
        try:
            answers += one_round(fleet, rounds, violations)
        except nesam.NesamError as error:
            violations.append(f"round {rounds}: {error}")
        rounds += 1
        if now - last >= SAMPLE_S or not last:
            last = now
            for name, process in watched.items():
                samples[name].append((time.monotonic() - begun, *sample(process)))
        if rounds % 30 == 0:
            print(f"  {now:6.0f} s: {rounds} rounds, {answers} answers, {len(violations)} violations", flush=True)
    print(f"{rounds} rounds, {answers} answers in {time.monotonic() - begun:.0f} s")
    keep(samples, fleet.folder / "soak.csv")
    print(f"{'process':<10} {'memory MB':>10} {'growth MB':>10} {'own':>7} {'file':>7} {'shared':>7} {'files':>6} {'growth':>7} {'threads':>8} {'growth':>7}")
    for name, rows in samples.items():
        rows = np.array(rows)[len(rows) // 3 :]
        length_s = rows[-1, 0] - rows[0, 0]
        resident, own, of_files, shared, files, threads = [np.polyfit(rows[:, 0], column, 1)[0] * length_s for column in rows[:, 1:].T]
        middle = np.median(rows[:, 1:], axis=0)
        parts = f"{own:>7.2f} {of_files:>7.2f} {shared:>7.2f}"
        print(f"{name:<10} {middle[0]:>10.1f} {resident:>10.2f} {parts} {middle[4]:>6.0f} {files:>7.1f} {middle[5]:>8.0f} {threads:>7.1f}")
        if name in REPLICAS:
            if resident > MEMORY_GROWTH * middle[0]:
                violations.append(f"{name}: memory grew by {resident:.1f} MB of {middle[0]:.0f} MB in {length_s:.0f} s")
            for what, grown in (("files", files), ("threads", threads)):
                if grown > COUNT_GROWTH:
                    violations.append(f"{name}: {what} grew by {grown:.1f} in {length_s:.0f} s")
    return violations
