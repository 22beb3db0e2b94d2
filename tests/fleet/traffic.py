"""What the fleet is there for: vehicles that stream a recorded drive, planners that ask, and what both must find in the end."""

import contextlib
import functools
import json
import queue
import threading
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import zenoh
from PIL import Image

import nesam
from nesam import _messages
from nesam.v1 import measurements_pb2
from serving import served

DATA = Path(__file__).resolve().parents[1] / "data/chrono_sample"
DRIVE, WORLD, MAP = "n0005", "w05", "w05"
STATE = ("x", "y", "z", "roll", "pitch", "yaw", "vbx", "vby", "vbz", "wx", "wy", "wz")
STEPS = 130
RATE_HZ = 20.0
"""Twice as fast as it was driven."""
PLAN_S = 0.2
PAUSE_S = 0.05
"""Between a call and its repetition, as retry policies of gRPC pause: at once, it may go over another connection that the proxy has kept to the same dead server."""
CONTROLS = np.stack(np.broadcast_arrays(np.linspace(1.0, 3.0, 4)[:, None], np.linspace(-0.3, 0.3, 16)), axis=-1).astype(np.float32)


def world():
    """The map of the drive."""
    folder = DATA / "worlds" / WORLD
    about = json.loads((folder / "world.json").read_text())
    heights = np.asarray(Image.open(folder / "elevation.png"), np.float32)[::-1]
    elevation = about["elevation"]["offset_m"] + about["elevation"]["scale_m"] * heights
    rgb = np.ascontiguousarray(np.asarray(Image.open(folder / "semantic.png").convert("RGB"))[::-1])
    return nesam.WorldMap(MAP, np.ascontiguousarray(elevation, np.float32), about["resolution_m"], origin_m=tuple(about["origin_m"]), semantic_rgb=rgb)


@functools.lru_cache
def recorded():
    """Columns of the recorded drives, and the rows of ours."""
    table = parquet.read_table(DATA / "nominal/samples.parquet", columns=["trajectory", "t", *STATE, "cmd_speed", "cmd_steer"])
    columns = {name: table[name].to_pylist() for name in table.column_names}
    return columns, [i for i, name in enumerate(columns["trajectory"]) if name == DRIVE][:STEPS]


def drive(session):
    """The measurements of a session."""
    columns, rows = recorded()
    return [
        nesam.Measurement(
            session,
            round(columns["t"][row] * 1e9),
            np.array([columns[name][row] for name in STATE]),
            (columns["cmd_speed"][row], columns["cmd_steer"][row]),
            sequence=i + 1,
        )
        for i, row in enumerate(rows)
    ]


def repeated(call, within_s=2.0, pause_s=PAUSE_S):
    """What a call gives that is repeated while its session moves from one server to another: what UNAVAILABLE asks of every client."""
    end = time.monotonic() + within_s
    while True:
        try:
            return call()
        except nesam.Unavailable:
            if time.monotonic() > end:
                raise
            time.sleep(pause_s)


class Outcome:
    """What a session knows in the end, as bytes."""

    def __init__(self, client, session):
        held = repeated(lambda: client.session(session))
        predicted = repeated(lambda: client.predict(session, CONTROLS))
        self.parts = {
            "measurements": held.accepted,
            "newest": (held.last_stamp_ns, held.last_sequence, held.state.tobytes()),
            "soil": (np.asarray(held.soil.delta).tobytes(), np.asarray(held.soil.covariance).tobytes()),
            "prediction": np.asarray(predicted.states).tobytes(),
        }

    def differences(self, other):
        return [name for name, part in self.parts.items() if other.parts[name] != part]


def without_failures(server, command):
    """The outcome of the drive on one server that nothing happens to."""
    with served(command([server, "serve", "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh"])) as address:
        with nesam.Client(address, timeout_s=60.0) as client:
            client.upload_map(world())
            client.open_session("oracle", map_id=MAP)
            client.measure(drive("oracle"))
            return Outcome(client, "oracle")


def start(vehicles, planners):
    """Opens the sessions and lets everybody drive and ask."""
    for vehicle in vehicles:
        vehicle.open()
    for thread in (*vehicles, *planners):
        thread.start()


def close(vehicles, planners):
    """Closes the sessions and the connections."""
    for vehicle in vehicles:
        with contextlib.suppress(nesam.NesamError):
            vehicle.client.close_session(vehicle.name)
    for thread in (*vehicles, *planners):
        thread.client.close()


class Vehicle(threading.Thread):
    """Streams its drive and keeps what is not durable."""

    def __init__(self, address, name, steps=None, rate_hz=RATE_HZ):
        super().__init__(name=name, daemon=True)
        self.client = nesam.Client(address, timeout_s=10.0, vehicle_id=name)
        self.steps, self._rate_hz = drive(name)[:steps], rate_hz
        self.violations, self.worst_s = [], 0.0

    def open(self):
        self.client.open_session(self.name, map_id=MAP)

    def run(self):
        try:
            with self.client.durable_stream(self.name, reconnect_s=20.0, pause_s=0.02) as stream:
                begun = time.monotonic()
                for i, measurement in enumerate(self.steps):
                    time.sleep(max(0.0, begun + i / self._rate_hz - time.monotonic()))
                    asked = time.monotonic()
                    answer = stream.send(measurement)
                    self.worst_s = max(self.worst_s, time.monotonic() - asked)
                    if answer.outcome not in ("APPLIED", "GATED", "DUPLICATE"):
                        self.violations.append(f"{self.name}: measurement {measurement.sequence} was {answer.outcome}: {answer.message}")
                stream.flush(timeout_s=20.0)
        except nesam.NesamError as error:
            self.violations.append(f"{self.name}: {error}")


class ZenohVehicle(threading.Thread):
    """Streams its drive over Zenoh, one measurement after the other, and sends what is not durable again when another server answers."""

    ANSWER_S = 0.3
    GIVE_UP_S = 20.0

    def __init__(self, address, name, router, fleet):
        super().__init__(name=name, daemon=True)
        self.client = nesam.Client(address, timeout_s=10.0, vehicle_id=name)
        self.steps, self._router, self._key = drive(name), router, f"nesam/v1/{fleet}/{name}/"
        self._answers = queue.Queue()
        self.violations, self.worst_s = [], 0.0

    def open(self):
        self.client.open_session(self.name, map_id=MAP)

    def run(self):
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([self._router]))
        with zenoh.open(config) as network:
            network.declare_subscriber(self._key + "status", lambda sample: self._answers.put(sample.payload.to_bytes()))
            publisher = network.declare_publisher(self._key + "measurement", congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(0.5)
            try:
                self._drive(publisher)
            except nesam.NesamError as error:
                self.violations.append(f"{self.name}: {error}")

    def _drive(self, publisher):
        begun, unsent, kept, run = time.monotonic(), list(self.steps), [], 0
        while unsent or kept:
            if not unsent:
                # All were received; are they durable?
                session = repeated(lambda: self.client.session(self.name))
                told, durable = session.run, session.durable_place
                time.sleep(0.05)
            else:
                measurement = unsent[0]
                time.sleep(max(0.0, begun + measurement.sequence / RATE_HZ - time.monotonic()))
                answer = self._exchange(publisher, measurement, run)
                if answer is None:
                    self.violations.append(f"{self.name}: measurement {measurement.sequence} was never answered")
                    return
                if answer.run == run and answer.WhichOneof("outcome") not in ("applied", "gated", "duplicate"):
                    self.violations.append(f"{self.name}: measurement {measurement.sequence} was {answer.WhichOneof('outcome')}")
                told, durable = answer.run, answer.durable_place
                if run in (0, told):
                    run = told
                    kept.append((unsent.pop(0), answer.place))
            if told != run:
                # Another server: what is not known to be durable goes again, in order.
                run, unsent, kept = told, [measurement for measurement, _ in kept] + unsent, []
            kept = [(measurement, place) for measurement, place in kept if place > durable]

    def _exchange(self, publisher, measurement, run):
        """Sends until there is an answer. One of another run has refused it, but for the first of all."""
        message = _messages.measurement_message(measurement)
        message.run = run
        asked = time.monotonic()
        while time.monotonic() < asked + self.GIVE_UP_S:
            publisher.put(message.SerializeToString())
            end = time.monotonic() + self.ANSWER_S
            while (left := end - time.monotonic()) > 0:
                try:
                    answer = measurements_pb2.MeasurementAnswer.FromString(self._answers.get(timeout=left))
                except queue.Empty:
                    break
                if answer.sequence == measurement.sequence:
                    self.worst_s = max(self.worst_s, time.monotonic() - asked)
                    return answer
        return None


class Planner(threading.Thread):
    """Asks again and again; a call that fails is repeated once, after a pause."""

    def __init__(self, address, session, every_s=PLAN_S):
        super().__init__(name=f"planner of {session}", daemon=True)
        # What fails is counted here, and not mended by the client.
        self.client = nesam.Client(address, timeout_s=8.0, vehicle_id=session, attempts_max=1)
        self._session, self._every_s = session, every_s
        self._ending = threading.Event()
        self._began = False
        self.answered, self.retried, self.violations, self.silence_s = 0, 0, [], 0.0

    def run(self):
        last = time.monotonic()
        while not self._ending.wait(self._every_s):
            for attempt in range(2):
                try:
                    self.client.predict(self._session, CONTROLS)
                    self._began = True
                    break
                except nesam.NesamError as error:
                    if isinstance(error, nesam.FailedPrecondition) and not self._began:
                        # The vehicle has not told its state yet.
                        break
                    if attempt == 1:
                        self.violations.append(f"{self.name}: two calls in a row failed: {type(error).__name__}: {error}")
                    else:
                        self.retried += 1
                        time.sleep(PAUSE_S)
            now = time.monotonic()
            self.answered += 1
            self.silence_s = max(self.silence_s, now - last)
            last = now

    def stop(self):
        self._ending.set()
        self.join(20.0)
