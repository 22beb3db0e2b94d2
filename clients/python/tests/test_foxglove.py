"""Goal: a recorded session is seen in the 3D views of Foxglove and Rerun. Method: the real server records a drive; what the export holds is read with the reader and
the schemas of their authors and held against the drive."""

import subprocess
import sys

import numpy as np
import pytest
from conftest import start_server
from test_client import fan

import nesam

pytest.importorskip("mcap")
pytest.importorskip("mcap_protobuf")
pytest.importorskip("foxglove_schemas_protobuf")


def hilly(session_id, steps):
    """A drive along a curve that pitches and rolls."""
    for i in range(steps):
        state = np.zeros(12)
        state[:6] = (0.2 * i - 5.0, 0.05 * i, 0.6, 0.05 * np.sin(i / 3), 0.1 * np.cos(i / 4), 0.02 * i)
        state[6] = 2.0
        yield nesam.Measurement(session_id, i * 100_000_000, state, (2.0, 0.0), sequence=i + 1)


@pytest.fixture
def recorded(request, tmp_path, hills):
    """The folder of a recording of 30 steps and one prediction, and that prediction."""
    server, address = start_server(request, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--record", "run", folder=tmp_path)
    with nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(hills)
        client.patch_tile("hills", 1, 0, 0, np.full((2, 2), 3.0, np.float32))
        client.open_session("truck", map_id="hills")
        client.measure(hilly("truck", 30))
        prediction = client.predict("truck", fan(5, 8))
    server.terminate()
    assert server.wait(timeout=30) == 0
    return tmp_path / "run", prediction


def command(*arguments):
    return subprocess.run([sys.executable, "-m", "nesam.foxglove", *map(str, arguments)], capture_output=True, text=True)


def read(path):
    """By topic the messages, decoded by the schemas in the file."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    told = {}
    with open(path, "rb") as file:
        for schema, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            told.setdefault(channel.topic, []).append((schema.name, message))
    return told


def points(cloud):
    """Positions (n, 3) and colours (n, 3) of a foxglove.PointCloud by its own description."""
    kinds = {1: "u1", 7: "<f4"}
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.type] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_stride,
        }
    )
    read = np.frombuffer(cloud.data, layout)
    return np.stack([read[n] for n in "xyz"], axis=1), np.stack([read[n] for n in ("red", "green", "blue")], axis=1)


def test_service_a_recording_is_seen_in_3d(recorded, tmp_path, hills):
    folder, prediction = recorded
    out = tmp_path / "seen.mcap"
    done = command(folder, out)
    assert done.returncode == 0, done.stderr
    told = read(out)
    drive = [measurement.state for measurement in hilly("truck", 30)]

    assert {name for name, _ in told["/tf"]} == {"foxglove.FrameTransform"} and len(told["/tf"]) == len(drive)
    for (_, transform), state in zip(told["/tf"], drive):
        assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "truck")
        np.testing.assert_allclose([transform.translation.x, transform.translation.y, transform.translation.z], state[:3])
        # The same rotation as a matrix, from the quaternion by the textbook and from the angles one after the other.
        q = transform.rotation
        turned = np.array(
            [
                [1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)],
                [2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x**2 + q.z**2), 2 * (q.y * q.z - q.x * q.w)],
                [2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x**2 + q.y**2)],
            ]
        )
        (cr, cp, cy), (sr, sp, sy) = np.cos(state[3:6]), np.sin(state[3:6])
        yaw, pitch = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]), np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        np.testing.assert_allclose(turned, yaw @ pitch @ roll, atol=1e-12)

    [(name, cloud)] = told["/truck/candidates"]
    assert name == "foxglove.PointCloud" and cloud.frame_id == "world"
    np.testing.assert_array_equal(points(cloud)[0], prediction.states[:, :, :3].reshape(-1, 3))

    ground = [cloud for _, cloud in told["/map/hills"]]
    before, after = (points(cloud)[0] for cloud in ground)
    assert len(before) == hills.elevation_m.size
    np.testing.assert_allclose(before[:, 2], hills.elevation_m.ravel())
    assert (after[[0, 1], 2] == 3.0).all() and (before[:2, :2] == [[-20.0, -15.0], [-19.75, -15.0]]).all()
    np.testing.assert_array_equal(points(ground[0])[1], hills.semantic_rgb.reshape(-1, 3))
    assert len(told["/measurement"]) == 30 and told["/truck/driven"] and told["/truck/pose"]


def test_service_rerun_draws_what_is_exported(recorded, tmp_path):
    """Rerun's own importer makes transforms and coloured points of it."""
    pytest.importorskip("rerun")
    folder, _ = recorded
    assert command(folder, tmp_path / "seen.mcap").returncode == 0
    rerun = [sys.executable, "-m", "rerun_cli"]
    converted = subprocess.run([*rerun, "mcap", "convert", tmp_path / "seen.mcap", "-o", tmp_path / "seen.rrd"], capture_output=True, text=True)
    assert converted.returncode == 0, converted.stderr
    drawn = subprocess.run([*rerun, "rrd", "print", tmp_path / "seen.rrd"], capture_output=True, text=True).stdout
    for entity, component in (("/tf", "Transform3D:translation"), ("/map/hills", "Points3D:colors"), ("/truck/candidates", "Points3D:positions")):
        assert any(f"- {entity} - " in line and component in line for line in drawn.splitlines()), (entity, component)


def test_service_what_is_no_recording_is_refused(recorded, tmp_path):
    folder, _ = recorded
    part = next(folder.glob("*.mcap"))
    (tmp_path / "text.mcap").write_text("no recording at all, and long enough")
    (tmp_path / "empty").mkdir()
    for source, out in ((tmp_path / "text.mcap", "a"), (tmp_path / "empty", "b"), (tmp_path / "nowhere", "c"), (part, part)):
        refused = command(source, tmp_path / out)
        assert refused.returncode == 2 and refused.stderr.startswith("error: "), refused
    # A killed server leaves no end; what is whole is shown.
    (tmp_path / "cut.mcap").write_bytes(part.read_bytes()[:-200])
    assert command(tmp_path / "cut.mcap", tmp_path / "cut-seen.mcap").returncode == 0
