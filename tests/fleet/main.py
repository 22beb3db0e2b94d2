"""tests/fleet/run: what must hold while parts of a fleet die. See `run`."""

import argparse
import shutil
import signal
import sys
import tempfile
import time

import hosts as network
import nesam
import scaling
import soak
import store_limit
import traffic
from services import REPLICAS, Fleet, slow_disk, why_no_slow_disk

VEHICLES = 6
"""Unless asked for others."""
ZENOH_VEHICLES = 2
"""Of them over Zenoh; the others over gRPC."""
FAULT_AFTER_S = 2.0
TAKEOVER_S = 2.0
"""Longest time that a planner may go without an answer, besides its own pause between two calls."""
SYNC_S = 0.1
"""How much longer each write to a slow disk takes."""
CUTS, SLOW_DISKS = "cuts", "slow disks"
IDLE_S = 20.0
"""Time after which a session that nobody uses is closed, or removed where no server has it."""


class Check:
    """One fault under load. `needs`: what this machine has to allow, CUTS or SLOW_DISKS; `members`: only with so many members of etcd."""

    def __init__(self, name, what, fault, needs=None, takes_over=True, members=1, moves=1):
        self.name, self.what, self.fault, self.needs, self.takes_over, self.members = name, what, fault, needs, takes_over, members
        # How often a session may lose its owner, so how many calls of one planner may fail.
        self.moves = moves


def victim(fleet, run):
    """The replica with most sessions."""
    owners = [owner for session, owner in fleet.owners().items() if session in run.sessions]
    return max(REPLICAS, key=owners.count)


def kill(fleet, run):
    name = victim(fleet, run)
    fleet.processes[name].kill()
    yield
    fleet.processes[name].start()
    fleet.await_healthy(name)


def stop_and_resume(fleet, run):
    name = victim(fleet, run)
    before = {session: owner for session, owner in fleet.owners().items() if owner == name and session in run.sessions}
    with nesam.Client(f"{fleet.hosts.address[name]}:50051", timeout_s=2.0, attempts_max=1) as direct:
        epochs = {session: direct.session(session).run for session in before}
        fleet.processes[name].signal(signal.SIGSTOP)
        yield
        fleet.processes[name].signal(signal.SIGCONT)
        # At once, past the proxy: the old owner may refuse, or ask for the session and then answer under a new epoch.
        for session, epoch in epochs.items():
            try:
                if direct.session(session).run == epoch:
                    run.violations.append(f"{name} answers for {session} under the epoch that it lost")
            except nesam.NesamError:
                pass
    fleet.await_healthy(name)


def cut_from_etcd(fleet, run):
    name = victim(fleet, run)
    for member in fleet.members:
        fleet.hosts.cut(name, member)
    yield
    for member in fleet.members:
        fleet.hosts.heal(name, member)
    fleet.await_healthy(name)


def cut_from_all(fleet, run):
    name = victim(fleet, run)
    fleet.hosts.cut(name)
    yield
    fleet.hosts.heal(name)
    fleet.await_healthy(name)


def slow_store(fleet, run):
    with slow_disk(fleet.processes[fleet.leader()].pid, SYNC_S):
        write_s = fleet.write_s()
        time.sleep(3.0)
    if write_s < SYNC_S:
        run.violations.append(f"the disk of etcd is not slow: a write takes {write_s:.2f} s")
    yield


def store_stutters(fleet, run):
    leader = fleet.processes[fleet.leader()]
    for _ in range(6):
        leader.signal(signal.SIGSTOP)
        time.sleep(0.3)
        leader.signal(signal.SIGCONT)
        time.sleep(0.2)
    yield


def store_restarts(fleet, run):
    leader = fleet.processes[fleet.leader()]
    leader.kill()
    leader.start()
    yield


def store_leader_dies(fleet, run):
    leader = fleet.processes[fleet.leader()]
    leader.kill()
    yield
    leader.start()


def router_restarts(fleet, run):
    fleet.processes["router"].kill()
    time.sleep(0.5)
    fleet.processes["router"].start()
    yield


def upgrade(fleet, run):
    for name in REPLICAS:
        status = fleet.upgrade(name)
        if status != 0:
            run.violations.append(f"{name} ended with {status} after SIGTERM")
    yield


CHECKS = [
    Check("kill", "SIGKILL of the replica with most sessions", kill),
    Check("stop", "SIGSTOP of an owner, SIGCONT when others have its sessions", stop_and_resume),
    Check("partition-store", "an owner cut off from etcd, not from its clients", cut_from_etcd, needs=CUTS),
    Check("partition", "an owner cut off from everybody", cut_from_all, needs=CUTS),
    Check("slow-store", f"a disk of etcd, of several members of the leader, that takes {SYNC_S} s longer for each write, for 3 s", slow_store, needs=SLOW_DISKS),
    Check("store-stutters", "etcd, of several members the leader, stopped for 0.3 s, six times in 3 s", store_stutters, takes_over=False),
    Check("store-restart", "SIGKILL of etcd, of several members of the leader, and restart", store_restarts, takes_over=False),
    Check("store-leader", "SIGKILL of the leading member of etcd, restart after the drives", store_leader_dies, members=3),
    Check("router-restart", "SIGKILL of the Zenoh router and restart", router_restarts, takes_over=False),
    Check("upgrade", "SIGTERM and restart of all replicas, one after the other", upgrade, moves=len(REPLICAS)),
]


def abandoned(fleet, vehicles):
    """All replicas die and come back, and nobody asks for the sessions: do they leave etcd?"""
    opened = [f"left-{i}" for i in range(vehicles)]
    for session in opened:
        with nesam.Client(fleet.proxy_address, timeout_s=10.0, vehicle_id=session) as client:
            client.open_session(session, map_id=traffic.MAP)
    until = time.monotonic() + 5.0
    while not set(opened) <= set(fleet.sessions()) and time.monotonic() < until:
        time.sleep(0.1)
    before = fleet.sessions()
    for name in REPLICAS:
        fleet.processes[name].kill()
    for name in REPLICAS:
        fleet.processes[name].start()
        fleet.await_healthy(name)
    begun = time.monotonic()
    while fleet.sessions() and time.monotonic() - begun < 2.0 * IDLE_S:
        time.sleep(0.2)
    took_s, left = time.monotonic() - begun, fleet.sessions()
    violations = [f"{name} is still in etcd" for name in left] + [f"{name} was never in etcd" for name in opened if name not in before]
    what = f"SIGKILL of all replicas; {len(before)} sessions without an owner left etcd after {took_s:.0f} s"
    row("abandoned", "VIOLATED" if violations else "holds", {}, what)
    return violations


class Run:
    """Vehicles and planners of one check, and what was found."""

    def __init__(self, fleet, name, vehicles):
        self.fleet = fleet
        self.sessions = [f"{name}-{i}" for i in range(vehicles)]
        self.vehicles = [traffic.Vehicle(fleet.proxy_address, session) for session in self.sessions[ZENOH_VEHICLES:]]
        router = f"tcp/{fleet.hosts.address['router']}:7447"
        self.vehicles += [traffic.ZenohVehicle(fleet.proxy_address, session, router, "fleet") for session in self.sessions[:ZENOH_VEHICLES]]
        self.planners = [traffic.Planner(fleet.proxy_address, session) for session in self.sessions]
        self.violations = []

    def drive(self, fault):
        """Everything drives, something dies, everything arrives."""
        since = self.fleet.revision()
        traffic.start(self.vehicles, self.planners)
        time.sleep(FAULT_AFTER_S)
        mending = fault(self.fleet, self)
        next(mending)
        for vehicle in self.vehicles:
            vehicle.join(60.0)
            if vehicle.is_alive():
                self.violations.append(f"{vehicle.name} does not arrive")
        for planner in self.planners:
            planner.stop()
        for _ in mending:
            pass
        for thread in (*self.vehicles, *self.planners):
            self.violations += thread.violations
        return since

    def compare(self, oracle):
        """Whether each session knows in the end what it would without failures."""
        for vehicle in self.vehicles:
            try:
                differences = traffic.Outcome(vehicle.client, vehicle.name).differences(oracle)
            except nesam.NesamError as error:
                differences = [str(error)]
            if differences:
                self.violations.append(f"{vehicle.name} differs from a run without failures: {', '.join(differences)}")

    def audit(self, since):
        """Whether each session had one owner at a time, and was written under one only. Gives the number of owners."""
        owned, count = set(), 0
        for revision, kind, session, put, new in self.fleet.history(since):
            if kind == "owner":
                if put and not new:
                    self.violations.append(f"{session}: a second owner in one epoch at revision {revision}")
                count += put
                (owned.add if put else owned.discard)(session)
            elif put and session not in owned:
                self.violations.append(f"{session}: written without an owner at revision {revision}")
        return count


def perform(check, fleet, oracle, vehicles, attempt):
    run = Run(fleet, f"{check.name}-{attempt}", vehicles)
    try:
        since = run.drive(check.fault)
        run.compare(oracle)
        owners = run.audit(since)
        for planner in run.planners:
            if planner.retried > check.moves:
                run.violations.append(f"{planner.name}: {planner.retried} calls were repeated, {check.moves} may be")
    finally:
        traffic.close(run.vehicles, run.planners)
    silence_s = max(planner.silence_s for planner in run.planners)
    late = check.takes_over and silence_s > TAKEOVER_S + traffic.PLAN_S
    figures = {
        "answers": sum(planner.answered for planner in run.planners),
        "retried": sum(planner.retried for planner in run.planners),
        "silence s": f"{silence_s:.2f}",
        "measured s": f"{max(vehicle.worst_s for vehicle in run.vehicles):.2f}",
        "owners": owners,
    }
    return figures, run.violations, late


def row(name, result, figures, what):
    print(f"{name:<16} {result:<9} " + " ".join(f"{figures.get(key, ''):>10}" for key in COLUMNS) + f"  {what}", flush=True)


COLUMNS = ("answers", "retried", "silence s", "measured s", "owners")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("server")
    parser.add_argument("--only", default="", help="checks, by name")
    parser.add_argument("--from", dest="before", metavar="NESAM", help="only the upgrade, from an older program, which lies where it finds its bundles")
    parser.add_argument("--envoy", action="store_true", help="Envoy in the place of HAProxy")
    parser.add_argument("--vehicles", type=int, default=VEHICLES, help=f"each with a planner [default: {VEHICLES}]")
    parser.add_argument("--loopback", action="store_true", help="without namespaces")
    parser.add_argument("--members", type=int, choices=(1, 3), default=1, help="members of etcd [default: 1]")
    parser.add_argument("--scaling", action="store_true", help="measure what sessions and queries cost, and check nothing")
    parser.add_argument("--memory", action="store_true", help="measure the memory of a session, and check nothing")
    parser.add_argument("--store-limit", action="store_true", help="measure how many vehicles one etcd bears, and check nothing")
    parser.add_argument("--soak", type=float, metavar="SECONDS", help="load for so long: do memory, files and threads stay?")
    parser.add_argument("--keep", default="", help="folder for logs and data; else they are thrown away when all holds")
    arguments = parser.parse_args()
    only = ["upgrade"] if arguments.before else [name for name in arguments.only.split(",") if name]
    unknown = set(only) - {check.name for check in CHECKS} - {"abandoned"}
    if unknown:
        parser.error(f"no check is called {', '.join(sorted(unknown))}")
    folder = arguments.keep or tempfile.mkdtemp(prefix="nesam-fleet-")
    measures = arguments.scaling or arguments.memory or arguments.store_limit or arguments.soak
    hosts, reason = network.make(arguments.loopback)
    print(f"hosts: {'network namespaces' if hosts.can_cut else 'loopback addresses (' + reason + ')'}; logs: {folder}", flush=True)
    failed, skipped = [], []
    fleet = Fleet(hosts, arguments.server, folder, arguments.members, 86400.0 if measures else IDLE_S, arguments.before, arguments.envoy)
    try:
        fleet.start()
        with nesam.Client(fleet.proxy_address, timeout_s=60.0, vehicle_id="maps") as client:
            client.upload_map(traffic.world())
        if arguments.store_limit:
            store_limit.measure(fleet)
            return 0
        if arguments.scaling or arguments.memory:
            (scaling.measure if arguments.scaling else scaling.memory)(fleet)
            return 0
        if arguments.soak:
            violations = soak.soak(fleet, arguments.soak)
            print("\n".join(violations) or "holds")
            return 1 if violations else 0
        oracle = traffic.without_failures(arguments.server, lambda command: hosts.command("client", command))
        missing = {CUTS: "" if hosts.can_cut else "needs network namespaces", SLOW_DISKS: why_no_slow_disk()}
        row("check", "result", dict(zip(COLUMNS, COLUMNS)), "what happens, two seconds after the start of the drives")
        for check in CHECKS:
            if (only and check.name not in only) or check.members > arguments.members:
                continue
            if missing.get(check.needs):
                skipped.append(check.name)
                row(check.name, "not run", {}, missing[check.needs])
                continue
            figures, violations, late = perform(check, fleet, oracle, arguments.vehicles, 1)
            if late and not violations:
                # Nothing is lost or wrong, and what else runs on the machine takes time, too.
                row(check.name, "late", figures, f"an answer took longer than {TAKEOVER_S} s; once more")
                figures, violations, late = perform(check, fleet, oracle, arguments.vehicles, 2)
            if late:
                violations.append(f"a planner waited {figures['silence s']} s for an answer")
            row(check.name, "VIOLATED" if violations else "holds", figures, check.what)
            for violation in violations[:8]:
                print(f"    {violation}", flush=True)
            failed += violations
        if not only or "abandoned" in only:
            failed += abandoned(fleet, arguments.vehicles)
        if arguments.envoy:
            declined = [f"Envoy declined calls: {counter}" for counter in fleet.declined_by_envoy()]
            print("\n".join(declined) or "Envoy declined nothing", flush=True)
            failed += declined
    finally:
        fleet.stop()
        hosts.close()
    if failed:
        print(f"{len(failed)} violations; logs are in {folder}")
        return 1
    if not arguments.keep:
        shutil.rmtree(folder, ignore_errors=True)
    return 2 if skipped else 0


if __name__ == "__main__":
    sys.exit(main())
