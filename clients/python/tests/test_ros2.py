"""Machines of ROS 2 against a real server: what is sent and heard is encoded and decoded by the package rosbags, which shares nothing with the server."""

import contextlib
import math
import queue
import struct
import time
from pathlib import Path

import numpy as np
import pytest

import nesam
from conftest import free_port, start_server

zenoh = pytest.importorskip("zenoh")
rosbags = pytest.importorskip("rosbags.typesys")
rosbag2 = pytest.importorskip("rosbags.rosbag2")

DOMAIN, STEP_NS = 3, 100_000_000
STORE = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
TYPES = STORE.types
COVARIANCE = np.zeros(36)
BAG = Path(__file__).resolve().parents[3] / "tests" / "data" / "ros2" / "n0005"


@pytest.fixture
def network(request, tmp_path):
    """A server in router mode that listens to the machine "husky-1": its gRPC client and a Zenoh session beside it."""
    with serving(request, tmp_path) as both:
        yield both


@contextlib.contextmanager
def serving(request, tmp_path, more=""):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = tmp_path / "ros2.toml"
    config.write_text(
        f'[zenoh]\nmode = "router"\nlisten = ["{endpoint}"]\n[ros2]\nenabled = true\ndomain = {DOMAIN}\nnode = "/fleet/nesam"\ncommand_hold_s = 30.0\n'
        'diagnostics_interval_s = 0.2\n[[ros2.vehicles]]\nvehicle = "husky-1"\nodometry = "odometry/filtered"\nreference_m = [0.5, 0.0, 0.0]\n' + more
    )
    process, address = start_server(request, "--config", str(config), "--grpc", "127.0.0.1:0", "--no-http")
    beside = zenoh.Config()
    beside.insert_json5("mode", '"client"')
    beside.insert_json5("connect/endpoints", f'["{endpoint}"]')
    with nesam.Client(address, timeout_s=60.0) as client, zenoh.open(beside) as machine:
        yield client, machine
    process.terminate()
    assert process.wait(timeout=30) == 0, "the server did not shut down cleanly"


def dds_name(kind):
    """The name of a type in keys."""
    package, name = kind.rsplit("/", 1)
    return f"{package.replace('/', '::')}::dds_::{name}_"


def key(topic, kind):
    """The key of a topic as rmw_zenoh makes it; the hash is rosbags' own."""
    return f"{DOMAIN}{topic}/{dds_name(kind)}/{STORE.hash_rihs01(kind)}"


def publisher(machine, of):
    """What is published faster than a busy server reads waits, and is not dropped."""
    return machine.declare_publisher(of, congestion_control=zenoh.CongestionControl.BLOCK)


def until_heard(publishers):
    deadline = time.monotonic() + 20.0
    while not all(publisher.matching_status.matching for publisher in publishers):
        assert time.monotonic() < deadline, "nobody listens"
        time.sleep(0.02)


def vector(*values):
    return TYPES["geometry_msgs/msg/Vector3"](*map(float, values))


RADIUS_M, SPEED_M_S = 20.0, 2.0


def odometry(stamp_ns, yaw_rad, speed_m_s=SPEED_M_S):
    """nav_msgs/msg/Odometry of a machine on a circle on level ground."""
    stamp = TYPES["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
    pose = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](RADIUS_M * math.sin(yaw_rad), RADIUS_M * (1.0 - math.cos(yaw_rad)), 0.6),
        TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)),
    )
    twist = TYPES["geometry_msgs/msg/Twist"](vector(speed_m_s, 0, 0), vector(0, 0, SPEED_M_S / RADIUS_M))
    message = TYPES["nav_msgs/msg/Odometry"](
        TYPES["std_msgs/msg/Header"](stamp, "odom"),
        "base_link",
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose, COVARIANCE),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, COVARIANCE),
    )
    return bytes(STORE.serialize_cdr(message, "nav_msgs/msg/Odometry"))


def twist(speed_m_s, yaw_rate_rad_s):
    message = TYPES["geometry_msgs/msg/Twist"](vector(speed_m_s, 0, 0), vector(0, 0, yaw_rate_rad_s))
    return bytes(STORE.serialize_cdr(message, "geometry_msgs/msg/Twist"))


class Heard:
    """What is published on a topic, decoded by rosbags, with its attachment."""

    def __init__(self, machine, topic, kind):
        self.messages, self.kind = queue.Queue(), kind
        self.subscriber = machine.declare_subscriber(key(topic, kind), self.messages.put)

    def next(self):
        sample = self.messages.get(timeout=20.0)
        number, sent_ns, length = struct.unpack("<qqB", sample.attachment.to_bytes()[:17])
        assert len(sample.attachment.to_bytes()) == 33 and length == 16 and abs(sent_ns - time.time_ns()) < 60e9
        return number, STORE.deserialize_cdr(sample.payload.to_bytes(), self.kind)

    def until(self, holds, what):
        deadline = time.monotonic() + 20.0
        while True:
            number, message = self.next()
            if holds(message):
                return number, message
            assert time.monotonic() < deadline, (what, message)


def test_service_a_machine_of_ros2_is_heard_and_told(network):
    client, machine = network
    diagnostics = Heard(machine, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    moved = publisher(machine, key("/husky_1/odometry/filtered", "nav_msgs/msg/Odometry"))
    told = publisher(machine, key("/husky_1/cmd_vel", "geometry_msgs/msg/Twist"))

    number, first = diagnostics.next()
    assert number >= 1 and abs(first.header.stamp.sec - time.time()) < 60
    (status,) = first.status
    assert (status.level, status.name, status.hardware_id, status.message) == (3, "nesam: husky-1", "husky-1", "no odometry yet")

    until_heard((moved, told))
    begin_ns = 1_700_000_000_000_000_000
    for i in range(60):
        told.put(twist(2.0, 0.1))
        moved.put(odometry(begin_ns + i * STEP_NS, 0.01 * i))
    _, heard = diagnostics.until(lambda message: dict(pairs(message)).get("history steps") == "32", "60 measurements")
    session = client.session("husky-1")
    assert (session.accepted, session.vehicle_id, session.history_steps) == (60, "husky-1", 32)
    # The reference point lies 0.5 m ahead of the base link and moves with its turning.
    yaw_rad = 0.59
    x_m, y_m = RADIUS_M * math.sin(yaw_rad) + 0.5 * math.cos(yaw_rad), RADIUS_M * (1.0 - math.cos(yaw_rad)) + 0.5 * math.sin(yaw_rad)
    expected = [x_m, y_m, 0.6, 0, 0, yaw_rad, 2.0, 0.05, 0, 0, 0, 0.1]
    np.testing.assert_allclose(session.state, expected, atol=1e-9)
    values = dict(pairs(heard))
    taken = sum(int(values.get(outcome, 0)) for outcome in ("applied", "buffered", "gated"))
    assert (values["command"], taken) == ("60", 60) and heard.status[0].level in (0, 1), values

    # What is wrong is told with its reason and changes nothing.
    moved.put(odometry(begin_ns + 60 * STEP_NS, 0.6, speed_m_s=500.0))
    _, heard = diagnostics.until(lambda message: message.status[0].level == 2, "a refusal")
    assert "state.velocity_m_s.x" in heard.status[0].message and client.session("husky-1").accepted == 60
    told.put(b"\x00\x01\x00\x00short")
    diagnostics.until(lambda message: dict(pairs(message)).get("command_refused") == "1", "a refusal of a command")


@pytest.mark.skipif(not BAG.is_dir(), reason="the recorded drive is in the repository")
def test_service_a_recorded_drive_tells_the_soil(request, tmp_path):
    truck = '[[ros2.vehicles]]\nvehicle = "truck"\ncommand = "ackermann_cmd"\ncommand_type = "ackermann_msgs/msg/AckermannDrive"\n'
    with serving(request, tmp_path, truck) as (client, machine), rosbag2.Reader(BAG) as bag:
        soil = Heard(machine, "/truck/soil", "std_msgs/msg/Float64MultiArray")
        topics = {connection.topic: f"{DOMAIN}{connection.topic}/{dds_name(connection.msgtype)}/{connection.digest}" for connection in bag.connections}
        listened_to = {topic: publisher(machine, topics[topic]) for topic in ("/truck/odom", "/truck/ackermann_cmd")}
        until_heard(listened_to.values())
        for connection, _, message in bag.messages():
            if connection.topic in listened_to:
                listened_to[connection.topic].put(message)
        deadline = time.monotonic() + 20.0
        while "truck" not in [s.session_id for s in client.sessions()] or client.session("truck").accepted < 101:
            assert time.monotonic() < deadline, "101 measurements"
            time.sleep(0.05)
        # The soil is told at each change, with the names of its axes; numbers count what was published. An effect begins it again from its prior.
        updates = client.session("truck").provenance.soil_epoch
        session = client.apply_effects("truck", [nesam.Effect("steering_offset", {"second": 0.05})])
        told = [soil.next() for _ in range(updates + 1)]
        assert [number for number, _ in told] == list(range(1, updates + 2)) and soil.messages.empty()
        array = told[-1][1]
        rows, columns = array.layout.dim
        assert (rows.label, rows.size, rows.stride) == ("delta,standard_deviation,learned", 3, 18)
        assert (columns.label, columns.size, columns.stride) == ("k_phi,k_c,n,c,phi,k_shear", 6, 6)
        delta, deviation, learned = np.asarray(array.data).reshape(3, 6)
        np.testing.assert_allclose(delta, session.soil.delta)
        np.testing.assert_allclose(deviation, np.sqrt(np.diag(session.soil.covariance)))
        assert learned.astype(bool).tolist() == list(session.soil.learned)


def test_service_the_server_is_a_node_of_the_graph(network):
    _, machine = network
    tokens = {str(reply.ok.key_expr).split("/", 2)[2].split("/", 1)[1] for reply in machine.liveliness().get(f"@ros2_lv/{DOMAIN}/**") if reply.ok}

    def end(number, role, topic, kind):
        return f"0/{number}/{role}/%/%fleet/nesam/{topic}/" + key("/", kind).split("//")[1] + "/::,10:,:,:,,"

    assert tokens == {
        "0/0/NN/%/%fleet/nesam",
        end(1, "MS", "%husky_1%cmd_vel", "geometry_msgs/msg/Twist"),
        end(2, "MS", "%husky_1%odometry%filtered", "nav_msgs/msg/Odometry"),
        end(3, "MP", "%husky_1%soil", "std_msgs/msg/Float64MultiArray"),
        end(4, "MP", "%diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
    }


def pairs(message):
    """Keys and values of the only status."""
    return [(value.key, value.value) for value in message.status[0].values]
