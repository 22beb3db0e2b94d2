"""A recording of `nesam serve --record` with what the 3D views of Foxglove and Rerun know: `python -m nesam.foxglove RECORDING OUT.mcap`.

    /tf                          foxglove.FrameTransform   each vehicle in `world`
    /<session>/pose              foxglove.PoseInFrame      the same as a pose
    /<session>/driven            foxglove.PosesInFrame     where it has been, once a second
    /<session>/candidates        foxglove.PointCloud       every step of every candidate of a prediction; orange where the service says something against it
    /map/<map>                   foxglove.PointCloud       the ground in its semantic colours, or by height
    /measurement, /measurement/answer, /soil               as recorded, for plots

Everything is told at the server's time of recording; the frame `world` is x east, y north, z up, a vehicle's frame x forward, y left, z up. Needs
`pip install nesam[foxglove]`.
"""

import argparse
import struct
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, Iterator, List, Tuple, Union

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.writer import Writer

from . import _types as t
from .v1 import measurements_pb2, prediction_pb2, soil_pb2, terrain_pb2

WORLD = "world"
POINTS_MAX = 400_000
"""Points of a cloud at most; of a larger one every second, third … row and column is shown."""
DRIVEN_MAX = 2_000
"""Poses of a driven path at most; of a longer one the newest."""

_AS_RECORDED: Dict[str, Any] = {
    "/measurement": measurements_pb2.Measurement,
    "/measurement/answer": measurements_pb2.MeasurementAnswer,
    "/soil": soil_pb2.SoilEstimate,
}
_AGAINST = ~int(t.Validity.SOIL_NOT_LEARNED | t.Validity.ALARM_ACTIVE | t.Validity.NO_MAP) & 0xFFFFFFFF
"""What the service says against one candidate; the other flags are of the session."""
_GOOD, _BAD = (0, 114, 178), (213, 94, 0)
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")])
_FIELDS = [
    PackedElementField(name=str(name), offset=offset, type=PackedElementField.FLOAT32 if name in "xyz" else PackedElementField.UINT8)
    for name, (_, offset, *_) in (_POINT.fields or {}).items()
]


def convert(recording: Path, out: Path) -> Dict[str, int]:
    """Writes `out` from a recording, a file or the folder of its parts; how many messages each topic got.

    Raises OSError (a file cannot be read or written), mcap.exceptions.McapError (it is no MCAP), ValueError (it holds no recording of nesam).
    """
    parts = sorted(recording.glob("*.mcap")) if recording.is_dir() else [recording]
    if not parts:
        raise ValueError(f"{recording} holds no recording: no file in it ends in .mcap")
    if out.resolve() in {part.resolve() for part in parts}:
        raise ValueError(f"{out} is the recording itself; give another name")
    written: Dict[str, int] = {}
    with open(out, "wb") as file, Writer(file) as writer:
        scene = _Scene()
        for part in parts:
            for topic, stamp_ns, payload in _messages(part):
                for to, message in scene.hear(topic, stamp_ns, payload):
                    writer.write_message(topic=to, message=message, log_time=stamp_ns, publish_time=stamp_ns)
                    written[to] = written.get(to, 0) + 1
    if not written:
        out.unlink()
        raise ValueError(f"{recording} holds no measurement, prediction or map of nesam")
    return written


def _messages(part: Path) -> Iterator[Tuple[str, int, bytes]]:
    """Topic, time and bytes of each message; of a recording that was cut off all that is whole."""
    ours, topics = set(), {}
    with open(part, "rb") as file:
        try:
            for record in StreamReader(file).records:
                if isinstance(record, Schema) and record.name.startswith("nesam.v1."):
                    ours.add(record.id)
                elif isinstance(record, Channel) and record.schema_id in ours:
                    topics[record.id] = record.topic
                elif isinstance(record, Message) and record.channel_id in topics:
                    yield topics[record.channel_id], record.log_time, record.data
        except (EndOfFile, struct.error):
            return


@dataclass
class _Map:
    header: terrain_pb2.MapHeader
    elevation_m: np.ndarray
    rgb: np.ndarray

    @classmethod
    def empty(cls, header: terrain_pb2.MapHeader) -> "_Map":
        shape = (header.height, header.width)
        return cls(header, np.full(shape, np.nan, np.float32), np.zeros((*shape, 3), np.uint8))

    def put(self, tile: terrain_pb2.MapTile) -> None:
        there = (slice(tile.row, tile.row + tile.rows), slice(tile.column, tile.column + tile.columns))
        self.elevation_m[there] = np.frombuffer(tile.elevation_m, "<f4").reshape(tile.rows, tile.columns)
        if tile.semantic_rgb:
            self.rgb[there] = np.frombuffer(tile.semantic_rgb, np.uint8).reshape(tile.rows, tile.columns, 3)

    def cloud(self, stamp_ns: int) -> PointCloud:
        """The ground without its holes."""
        every = max(1, int(np.ceil(np.sqrt(self.elevation_m.size / POINTS_MAX))))
        rows, columns = np.mgrid[0 : self.header.height : every, 0 : self.header.width : every]
        z = self.elevation_m[rows, columns]
        known = np.isfinite(z)
        xy = [self.header.origin_x_m + columns * self.header.resolution_m, self.header.origin_y_m + rows * self.header.resolution_m]
        colours = self.rgb[rows, columns] if self.header.semantic else _by_height(z)
        return _cloud(np.stack([*xy, z], axis=-1)[known], colours[known], stamp_ns)


class _Scene:
    """What is on the maps and where the vehicles have been, told message by message."""

    def __init__(self) -> None:
        self._maps: Dict[str, _Map] = {}
        self._asked_map: Union[_Map, terrain_pb2.PatchTileRequest, None] = None
        self._driven: Dict[str, List[Pose]] = {}
        self._told_ns: Dict[str, int] = {}
        self._asked = prediction_pb2.PredictRequest()

    def hear(self, topic: str, stamp_ns: int, payload: bytes) -> Iterator[Tuple[str, Any]]:
        """What a recorded message is shown as, by topic."""
        if topic in _AS_RECORDED:
            yield topic, _AS_RECORDED[topic].FromString(payload)
        if topic == "/measurement":
            yield from self._measured(stamp_ns, measurements_pb2.Measurement.FromString(payload))
        elif topic == "/predict":
            self._asked = prediction_pb2.PredictRequest.FromString(payload)
        elif topic == "/prediction":
            yield from _candidates(self._asked.session_id, stamp_ns, prediction_pb2.PredictReply.FromString(payload))
        elif topic == "/map/upload":
            self._upload(terrain_pb2.UploadMapRequest.FromString(payload))
        elif topic == "/map/patch":
            self._asked_map = terrain_pb2.PatchTileRequest.FromString(payload)
        elif topic == "/map":
            yield from self._changed(terrain_pb2.MapDescription.FromString(payload).map_id, stamp_ns)
        if not topic.startswith("/map"):
            # The answer to a map that was refused is none of a map.
            self._asked_map = None

    def _upload(self, part: terrain_pb2.UploadMapRequest) -> None:
        if part.HasField("header"):
            self._asked_map = _Map.empty(part.header)
        elif isinstance(self._asked_map, _Map):
            self._asked_map.put(part.tile)

    def _changed(self, map_id: str, stamp_ns: int) -> Iterator[Tuple[str, Any]]:
        """The map after what was asked of it last, where that is what is answered."""
        asked, self._asked_map = self._asked_map, None
        if isinstance(asked, _Map) and asked.header.map_id == map_id:
            self._maps[map_id] = asked
        elif isinstance(asked, terrain_pb2.PatchTileRequest) and asked.map_id == map_id and map_id in self._maps:
            self._maps[map_id].put(asked.tile)
        else:
            return
        yield f"/map/{map_id}", self._maps[map_id].cloud(stamp_ns)

    def _measured(self, stamp_ns: int, measurement: measurements_pb2.Measurement) -> Iterator[Tuple[str, Any]]:
        state = t.state_array(measurement.state)
        if not np.isfinite(state).all():
            return
        session, pose, stamp = measurement.session_id, _pose(state), _stamp(stamp_ns)
        yield "/tf", FrameTransform(
            timestamp=stamp, parent_frame_id=WORLD, child_frame_id=session, translation=pose.position, rotation=pose.orientation
        )
        yield f"/{session}/pose", PoseInFrame(timestamp=stamp, frame_id=WORLD, pose=pose)
        driven = self._driven.setdefault(session, [])
        driven.append(pose)
        del driven[:-DRIVEN_MAX]
        if stamp_ns - self._told_ns.get(session, -(10**9)) >= 10**9:
            self._told_ns[session] = stamp_ns
            yield f"/{session}/driven", PosesInFrame(timestamp=stamp, frame_id=WORLD, poses=driven)


def _candidates(session: str, stamp_ns: int, reply: prediction_pb2.PredictReply) -> Iterator[Tuple[str, PointCloud]]:
    channels = bin(reply.channels).count("1")
    if reply.channels & 0b111 != 0b111 or reply.precision == prediction_pb2.PRECISION_F16 or not reply.states:
        return
    positions = np.frombuffer(reply.states, "<f4").reshape(-1, reply.steps, channels)[:, :, :3]
    flags = np.zeros(len(positions), np.uint32)
    flags[: len(reply.validity)] = reply.validity
    colours = np.where((flags & _AGAINST != 0)[:, None], _BAD, _GOOD).astype(np.uint8)
    yield f"/{session}/candidates", _cloud(positions.reshape(-1, 3), np.repeat(colours, reply.steps, axis=0), stamp_ns)


def _cloud(points: np.ndarray, colours: np.ndarray, stamp_ns: int) -> PointCloud:
    """A cloud of points (n, 3), m in World, in colours (n, 3) uint8."""
    known = np.isfinite(points).all(axis=1)
    packed = np.zeros(int(known.sum()), _POINT)
    for i, name in enumerate("xyz"):
        packed[name] = points[known, i]
    for i, name in enumerate(("red", "green", "blue")):
        packed[name] = colours[known, i]
    packed["alpha"] = 255
    return PointCloud(
        timestamp=_stamp(stamp_ns), frame_id=WORLD, pose=_pose(np.zeros(6)), point_stride=_POINT.itemsize, fields=_FIELDS, data=packed.tobytes()
    )


def _by_height(z: np.ndarray) -> np.ndarray:
    """Brown to green to white from the lowest to the highest, (…, 3) uint8."""
    low, high = (np.nanmin(z), np.nanmax(z)) if np.isfinite(z).any() else (0.0, 1.0)
    share = np.nan_to_num((z - low) / max(1e-6, float(high - low)))
    stops = np.array([(94, 74, 52), (96, 130, 70), (235, 235, 225)])
    return np.stack([np.interp(share, (0.0, 0.5, 1.0), stops[:, i]) for i in range(3)], axis=-1).astype(np.uint8)


def _pose(state: np.ndarray) -> Pose:
    """Position and attitude of x y z roll pitch yaw …; the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(state[3:6] / 2), np.sin(state[3:6] / 2)
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = state[:3]
    pose.orientation.w = cr * cp * cy + sr * sp * sy
    pose.orientation.x = sr * cp * cy - cr * sp * sy
    pose.orientation.y = cr * sp * cy + sr * cp * sy
    pose.orientation.z = cr * cp * sy - sr * sp * cy
    return pose


def _stamp(stamp_ns: int) -> Timestamp:
    return Timestamp(seconds=stamp_ns // 10**9, nanos=stamp_ns % 10**9)


def main() -> int:
    """Exit code: 0 done, 2 wrong usage or input."""
    arguments = argparse.ArgumentParser(prog="python -m nesam.foxglove", description="Turns a recording into one that the 3D views of Foxglove and Rerun show.")
    arguments.add_argument("recording", type=Path, help="file or folder of `nesam serve --record`")
    arguments.add_argument("out", type=Path, help="MCAP file to write")
    given = arguments.parse_args()
    try:
        written = convert(given.recording, given.out)
    except (OSError, ValueError, McapError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for topic, count in sorted(written.items()):
        print(f"{count:8} {topic}")
    print(f"wrote {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
