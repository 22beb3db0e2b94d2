"""A vehicle that reports over Zenoh: copy this and replace `measured` by what the vehicle measures.

    python zenoh_publisher.py --connect tcp/127.0.0.1:7447 --fleet default --vehicle truck-1 --rate 50 --seconds 10
    python zenoh_publisher.py --connect tls/router:7447 --authority fleet-ca.pem --certificate truck-1.pem --key truck-1.key --vehicle truck-1

A session named like the vehicle has to be open (over gRPC). Every measurement carries its number and the id of this start of the program, so that the service
can tell repeated, late and lost measurements, a clock that was set, and a restart apart. It answers each one on `.../status`; what it has no answer to
may be sent again at any time.
"""

import argparse
import json
import math
import random
import sys
import time

import zenoh
from nesam.v1 import measurements_pb2, types_pb2


class ZenohVehicle:
    """A vehicle in a Zenoh network. While it exists, its liveliness token `nesam/v1/<fleet>/<vehicle>/alive` tells everybody that it is there."""

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
        self._answers = self._session.declare_subscriber(f"{key}/status", lambda sample: on_answer(answer_of(sample)))
        self._boot_id = random.getrandbits(63) | 1
        self._sequence = 0

    def heard(self) -> bool:
        """Whether a service listens to the measurements."""
        return self._publisher.matching_status.matching

    def publish(self, stamp_ns: int, state, command) -> measurements_pb2.Measurement:
        """Sends one measurement: the vehicle's clock, x y z roll pitch yaw vx vy vz wx wy wz, and (speed, second command) applied from now on."""
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
        self.send(measurement)
        return measurement

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
        if kind == "REJECTED":
            print(f"measurement {answer.sequence}: {answer.rejected.message}", file=sys.stderr)

    try:
        vehicle = ZenohVehicle(arguments.connect, arguments.fleet, arguments.vehicle, on_answer, tls if all(tls) else None)
    except zenoh.ZError as error:
        print(f"error: {arguments.connect}: {error}", file=sys.stderr)
        return 1
    count = int(arguments.seconds * arguments.rate)
    try:
        report(vehicle, arguments.rate, count)
        deadline = time.monotonic() + 5.0
        while sum(counts.values()) < count and time.monotonic() < deadline:
            time.sleep(0.05)
    except KeyboardInterrupt:
        return 130
    finally:
        vehicle.close()
    print("  ".join(f"{kind} {n}" for kind, n in sorted(counts.items())))
    return 0 if sum(counts.values()) == count else 1


if __name__ == "__main__":
    sys.exit(main())
