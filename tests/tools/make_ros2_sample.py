#!/usr/bin/env python3
"""Writes the committed bag of ROS 2: a drive of the committed sample as a machine would have recorded it.

Messages are encoded by the Python package rosbags, which shares nothing with this repository, so that the tests hold the reader of bags and the ROS 2 side of the
server against another implementation of CDR and of bags.

    python3 tests/tools/make_ros2_sample.py --source tests/data/chrono_sample --out tests/data/ros2

Needs rosbags, numpy and pyarrow. The same source gives the same messages; stamps begin at a fixed instant.
"""

import argparse
import json
import pathlib
import shutil

import numpy as np
import pyarrow.parquet as pq
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

DRIVE, SAMPLES = "n0005", 101
BEGIN_NS, STEP_NS = 1_700_000_000_000_000_000, 100_000_000
# ackermann_msgs is not among the packages that rosbags knows: its definitions, field by field.
ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n",
}


def quaternion(roll, pitch, yaw):
    """x, y, z, w of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(0.5 * a), np.sin(0.5 * a)) for a in (roll, pitch, yaw))
    return sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", type=pathlib.Path, required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    options = parser.parse_args()

    rows = [row for row in pq.read_table(options.source / "nominal" / "samples.parquet").to_pylist() if row["trajectory"] == DRIVE][:SAMPLES]
    card = json.loads((options.source / "vehicle_hmmwv.json").read_text())
    table = card["steering"]["command_to_road_wheel_table"]
    mean = [0.5 * (entry["fl_rad"] + entry["fr_rad"]) for entry in table]

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in ACKERMANN.items():
        store.register(get_types_from_msg(text, name))
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"]
    folder = options.out / DRIVE
    shutil.rmtree(folder, ignore_errors=True)
    options.out.mkdir(parents=True, exist_ok=True)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        def connect(topic, kind):
            connection = bag.add_connection(topic, kind, typestore=store)
            return lambda at_ns, message: bag.write(connection, at_ns, store.serialize_cdr(message, kind))

        odometry = connect("/truck/odom", "nav_msgs/msg/Odometry")
        steered = connect("/truck/ackermann_cmd", "ackermann_msgs/msg/AckermannDrive")
        twisted = connect("/truck/cmd_vel", "geometry_msgs/msg/Twist")
        for i, row in enumerate(rows):
            at_ns = BEGIN_NS + i * STEP_NS
            angle = float(np.interp(row["cmd_steer"], [entry["cmd"] for entry in table], mean))
            speed = row["cmd_speed"]
            # Commands are recorded just before the odometry from whose instant on they hold.
            steered(at_ns - 1000, types["ackermann_msgs/msg/AckermannDrive"](angle, 0.0, speed, 0.0, 0.0))
            turning = speed * np.tan(angle) / card["wheelbase"]
            twisted(at_ns - 1000, types["geometry_msgs/msg/Twist"](vector(speed, 0.0, 0.0), vector(0.0, 0.0, turning)))
            stamp = types["builtin_interfaces/msg/Time"](*divmod(at_ns, 1_000_000_000))
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](row["x"], row["y"], row["z"]),
                types["geometry_msgs/msg/Quaternion"](*quaternion(row["roll"], row["pitch"], row["yaw"])),
            )
            twist = types["geometry_msgs/msg/Twist"](vector(row["vbx"], row["vby"], row["vbz"]), vector(row["wx"], row["wy"], row["wz"]))
            unknown = np.zeros(36)
            odometry(at_ns, types["nav_msgs/msg/Odometry"](
                types["std_msgs/msg/Header"](stamp, "odom"),
                "base_link",
                types["geometry_msgs/msg/PoseWithCovariance"](pose, unknown),
                types["geometry_msgs/msg/TwistWithCovariance"](twist, unknown),
            ))
    print(f"{folder}: {len(rows)} messages of odometry")


if __name__ == "__main__":
    main()
