"""A vehicle that reports over Zenoh: copy this and replace `measured` by what the vehicle measures.

    python zenoh_publisher.py --connect tcp/127.0.0.1:7447 --fleet default --vehicle truck-1 --rate 50 --seconds 10
    python zenoh_publisher.py --connect tls/router:7447 --authority fleet-ca.pem --certificate truck-1.pem --key truck-1.key --vehicle truck-1

A session named like the vehicle has to be open (over gRPC). Every measurement carries its number and the id of this start of the program, so that the service
can tell repeated, late and lost measurements, a clock that was set, and a restart apart. It answers each one on `.../status`. What has no answer is sent again
before anything newer: behind a newer measurement the service takes nothing that is older than its reorder window (0.2 s), it is TOO_OLD and lost.
"""

import argparse
import json
import math
import random
import sys
import threading
import time

import zenoh
from nesam.v1 import measurements_pb2, types_pb2


SILENCE_S = 1.0
"""After so long without an answer what is on its way is taken for lost."""

AT_ONCE_MAX = 256
"""Measurements that are sent in a row at most."""

KEPT_MAX = 8192
"""Measurements that are kept at most; beyond that the oldest are given up. A minute and a half at the fastest rate."""

NO_ROOM = (8, 14)
"""google.rpc.Code of a service that has no room now or is about to go: it is to be sent again."""


class ZenohVehicle:
    """A vehicle in a Zenoh network. While it exists, its liveliness token `nesam/v1/<fleet>/<vehicle>/alive` tells everybody that it is there.

    A measurement is kept until it is answered, where the service keeps a store until it is durable, and sent again where that does not come: after SILENCE_S, or
    when the service says that it was started again (`run`). Nothing newer goes before it.
    """

    def __init__(self, endpoint: str, fleet: str, vehicle: str, on_answer, tls=None):
        """tls: files (authority, certificate, key) for an endpoint `tls/...`; the certificate's common name is nesam:vehicle:<vehicle>."""
        config = zenoh.Config()
        if tls is not None:
            for name, file in zip(("root_ca_certificate", "connect_certificate", "connect_private_key"), tls):
                config.insert_json5(f"transport/link/tls/{name}", json.dumps(str(file)))
            config.insert_json5("transport/link/tls/enable_mtls", "true")
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        key = f"nesam/v1/{fleet}/{vehicle}"
        self._session = zenoh.open(config)
        self._token = self._session.liveliness().declare_token(f"{key}/alive")
        # `BLOCK` waits while the network is congested rather than losing a measurement; a vehicle whose control loop must not wait leaves it out.
        self._publisher = self._session.declare_publisher(f"{key}/measurement", congestion_control=zenoh.CongestionControl.BLOCK)
        self._boot_id = random.getrandbits(63) | 1
        self._sequence = 0
        self._lock = threading.Lock()
        # By number, the oldest first; and the places of those that the service has accepted.
        self._kept, self._places = {}, {}
        # The number to be sent next, which run of the service has answered, when it did last, and whether it is silent since.
        self._next, self._run, self._heard_s, self._is_silent = 1, 0, time.monotonic(), False
        self._on_answer = on_answer
        self._answers = self._session.declare_subscriber(f"{key}/status", lambda sample: self._hear(answer_of(sample)))

    def heard(self) -> bool:
        """Whether a service listens to the measurements."""
        return self._publisher.matching_status.matching

    def publish(self, stamp_ns: int, state, command) -> measurements_pb2.Measurement:
        """Sends one measurement: the vehicle's clock, x y z roll pitch yaw vx vy vz wx wy wz, and (speed, second command) applied from now on. It waits behind
        those that have to be sent again."""
        self._sequence += 1
        vectors = [types_pb2.Vector3(x=state[i], y=state[i + 1], z=state[i + 2]) for i in (0, 3, 6, 9)]
        measurement = measurements_pb2.Measurement(
            sequence=self._sequence,
            boot_id=self._boot_id,
            stamp_ns=stamp_ns,
            state=types_pb2.VehicleState(
                position_m=vectors[0], attitude_rad=vectors[1], velocity_m_s=vectors[2], angular_velocity_rad_s=vectors[3]
            ),
            command=types_pb2.Control(speed_m_s=command[0], second=command[1]),
        )
        with self._lock:
            if len(self._kept) == len(self._places):
                # Nothing was waited for.
                self._heard_s = time.monotonic()
            self._kept[measurement.sequence] = measurement
            if len(self._kept) > KEPT_MAX:
                self._forget(next(iter(self._kept)))
        self.send_due()
        return measurement

    def unanswered(self) -> int:
        """How many measurements have no answer."""
        with self._lock:
            return len(self._kept) - len(self._places)

    def send_due(self) -> None:
        """Sends what waits: all without an answer after a silence, else what has not been sent. `publish` does it; without one call it now and then."""
        with self._lock:
            now = time.monotonic()
            is_late = now - self._heard_s > SILENCE_S
            if is_late:
                self._heard_s, self._is_silent = now, True
            elif self._is_silent:
                # The service may be back at any moment, and takes nothing older then.
                return
            numbers = list(self._kept) if is_late else range(self._next, self._sequence + 1)
            due = [self._kept[number] for number in numbers if number in self._kept and number not in self._places][:AT_ONCE_MAX]
            for measurement in due:
                measurement.run, self._next = self._run, measurement.sequence + 1
        for measurement in due:
            self.send(measurement)

    def _hear(self, answer: measurements_pb2.MeasurementAnswer) -> None:
        """Notes an answer, and passes it on."""
        rejected = answer.rejected if answer.WhichOneof("outcome") == "rejected" else None
        with self._lock:
            if rejected is not None and rejected.field == "run":
                if answer.run != self._run:
                    # Started again, from what was durable: all that is kept has no answer there, and comes first.
                    self._run, self._heard_s = answer.run, -math.inf
                    self._places.clear()
            elif rejected is None or rejected.code not in NO_ROOM:
                self._run, self._heard_s, self._is_silent = answer.run or self._run, time.monotonic(), False
                self._settle(answer)
        self._on_answer(answer)

    def _settle(self, answer: measurements_pb2.MeasurementAnswer) -> None:
        """Forgets what is refused or durable; what is only accepted stays, in case that the service crashes."""
        if answer.sequence in self._kept:
            if answer.place:
                self._places[answer.sequence] = answer.place
            else:
                self._forget(answer.sequence)
        while self._kept and self._places.get(oldest := next(iter(self._kept)), math.inf) <= answer.durable_place:
            self._forget(oldest)

    def _forget(self, number: int) -> None:
        self._kept.pop(number)
        self._places.pop(number, None)

    def send(self, measurement: measurements_pb2.Measurement) -> None:
        """Sends a measurement as it is, for instance once more."""
        self._publisher.put(measurement.SerializeToString())

    def close(self) -> None:
        """Leaves the network; the token goes with it."""
        self._session.close()


def answer_of(sample) -> measurements_pb2.MeasurementAnswer:
    """The answer in a sample."""
    answer = measurements_pb2.MeasurementAnswer()
    answer.ParseFromString(sample.payload.to_bytes())
    return answer


def measured(t_s: float):
    """State and command of a made-up vehicle on a circle of 20 m at 2 m/s. Replace this."""
    speed, radius = 2.0, 20.0
    yaw = speed * t_s / radius
    position = [radius * math.sin(yaw), radius * (1.0 - math.cos(yaw)), 0.6]
    yaw = math.remainder(yaw, math.tau)
    return [*position, 0.0, 0.0, yaw, speed, 0.0, 0.0, 0.0, 0.0, speed / radius], [speed, 0.1]


def report(vehicle: ZenohVehicle, rate: float, count: int) -> None:
    """Publishes so many measurements as soon as somebody listens."""
    begun, told = time.monotonic(), False
    while not vehicle.heard():
        if not told and time.monotonic() - begun > 2.0:
            told = True
            print("waiting for a service that listens to this fleet", file=sys.stderr)
        time.sleep(0.05)
    start = time.monotonic()
    for i in range(count):
        due = i / rate
        time.sleep(max(0.0, start + due - time.monotonic()))
        vehicle.publish(time.time_ns(), *measured(due))


def main() -> int:
    """Exit code: 0 every measurement was answered, 1 not, 2 wrong usage, 130 interrupted."""
    parser = argparse.ArgumentParser(description="Publishes measurements of a made-up vehicle over Zenoh.")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="endpoint of the router or server (%(default)s)")
    parser.add_argument("--fleet", default="default", help="as the server names it, zenoh.fleet (%(default)s)")
    parser.add_argument("--vehicle", default="truck-1", help="name of an open session (%(default)s)")
    parser.add_argument("--rate", type=float, default=50.0, help="measurements per second, 10 to 200 (%(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to publish, s (%(default)s)")
    parser.add_argument("--authority", help="for tls/...: authority of the router's certificate, PEM")
    parser.add_argument("--certificate", help="this vehicle's certificate, common name nesam:vehicle:<vehicle>")
    parser.add_argument("--key", help="its private key")
    arguments = parser.parse_args()
    tls = (arguments.authority, arguments.certificate, arguments.key)
    if any(tls) and not all(tls):
        parser.error("--authority, --certificate and --key go together")
    if not 10.0 <= arguments.rate <= 200.0:
        parser.error("--rate is 10 to 200")
    counts = {}

    def on_answer(answer):
        kind = (answer.WhichOneof("outcome") or "unknown").upper()
        counts[kind] = counts.get(kind, 0) + 1
        if kind == "REJECTED" and answer.rejected.field != "run":
            print(f"measurement {answer.sequence}: {answer.rejected.message}", file=sys.stderr)

    try:
        vehicle = ZenohVehicle(arguments.connect, arguments.fleet, arguments.vehicle, on_answer, tls if all(tls) else None)
    except zenoh.ZError as error:
        print(f"error: {arguments.connect}: {error}", file=sys.stderr)
        return 1
    try:
        report(vehicle, arguments.rate, int(arguments.seconds * arguments.rate))
        deadline = time.monotonic() + 5.0
        while vehicle.unanswered() and time.monotonic() < deadline:
            time.sleep(0.05)
            vehicle.send_due()
        lost = vehicle.unanswered()
    except KeyboardInterrupt:
        return 130
    finally:
        vehicle.close()
    print("  ".join(f"{kind} {n}" for kind, n in sorted(counts.items())))
    return 0 if not lost else 1


if __name__ == "__main__":
    sys.exit(main())
