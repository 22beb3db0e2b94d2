"""Makes the corpora of messages in tests/hostile/corpus from a real server: target/python-client/bin/python tests/tools/hostile_messages.py target/release/nesam

Run it again when the messages change; what it writes is committed."""

import dataclasses
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from google.protobuf.internal.encoder import _VarintBytes

import nesam
from nesam import _calls as calls
from nesam import _messages as messages
from nesam.v1 import effects_pb2, session_image_pb2, sharing_pb2, soil_pb2, terrain_pb2, types_pb2
from serving import served

CORPUS = Path(__file__).resolve().parents[1] / "hostile/corpus"


def keep(reader, name, content):
    folder = CORPUS / reader
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(content)


def requests():
    """Messages that clients send."""
    state = np.zeros(12)
    state[:9] = -8.0, 1.0, 0.6, 0.01, -0.02, 0.3, 2.0, 0.05, 0.0
    measurement = nesam.Measurement("truck", 12_300_000_000, state, (2.0, -0.1), sequence=7)
    keep("measurement", "valid.bin", messages.measurement_message(measurement).SerializeToString())
    keep("open_session", "valid.bin", calls.open_session("truck", "truck", "hills", "", measurement).request.SerializeToString())
    controls = np.tile(np.float32([2.0, 0.1]), (3, 5, 1))
    extras = nesam.Extras(jacobians=True, covariance=True)
    cost = nesam.PathCost(np.float32([[0, 0], [5, 0]]), 2.0, best=2)
    for name, question in {
        "valid": calls.Question("truck", controls),
        "extras": calls.Question("truck", controls, start=state, channels=("x", "yaw"), stride=2, extras=extras),
        "ranked": calls.Question("truck", controls, cost=cost, half=True, samples_min=1),
        "drawn": calls.Question("truck", nesam.Drawing(controls[0], 4, (0.5, 0.1), seed=3)),
        "from_now": calls.Question("truck", controls, start_stamp_ns=12_400_000_000, sent=[(12_300_000_000, (2.0, 0.0))]),
    }.items():
        keep("predict", f"{name}.bin", question.call().request.SerializeToString())
    world = nesam.WorldMap("hills", np.zeros((9, 11), np.float32), 0.5, origin_m=(-2.0, -2.0), semantic_rgb=np.full((9, 11, 3), 90, np.uint8))
    parts = [part.SerializeToString() for part in calls.upload_map(world).request]
    keep("map_messages", "valid.bin", b"".join(len(part).to_bytes(2, "little") + part for part in parts))
    # As a store keeps it: each message behind its length as a varint.
    keep("stored_map", "valid.bin", b"".join(_VarintBytes(len(part)) + part for part in parts))
    tile = terrain_pb2.MapTile(column=2, row=1, columns=3, rows=2, elevation_m=np.full(6, 0.25, "<f4").tobytes(), semantic_rgb=bytes(range(18)))
    keep("map_tile", "valid.bin", tile.SerializeToString())
    given = {"payload": {"mass_kg": 300.0, "x_m": -0.5, "y_m": 0.0, "z_m": 0.4}, "steering_delay": {"seconds": 0.2}}
    effects = [
        effects_pb2.Effect(id=name, parameters=[effects_pb2.EffectParameter(name=n, value=v) for n, v in values.items()]) for name, values in given.items()
    ]
    applied = effects_pb2.ApplyEffectsRequest(session_id="truck", source="by hand", effects=effects)
    keep("apply_effects", "valid.bin", applied.SerializeToString())
    return state, world


def of_servers():
    """What a server tells the others of the soil."""
    cell = soil_pb2.FleetSoilCell(map_id="hills", colour_rgb=0x586878, column=-1, row=2, buffers=1.5, age_s=3.0)
    cell.information.extend(np.diag([4.0, 1.0, 9.0, 1.0, 2.0, 1.0]).ravel())
    cell.vector.CopyFrom(types_pb2.SoilVector(k_phi=0.5, k_c=0.1, n=-0.2, c_pa=0.0, phi_rad=0.1, k_shear_m=0.0))
    share = sharing_pb2.FleetSoilShare(service="18c4f0a1b2c3d4e5", cells=[sharing_pb2.SharedSoilCell(cell=cell, votes=0.5, revision=3)])
    told = sharing_pb2.FleetSoilShares(bundle_hash="0" * 64, cell_m=10.0, shares=[share, share])
    keep("fleet_soil_shares", "valid.bin", told.SerializeToString())


def of_a_server(binary, state, world):
    """An exported session and a recording."""
    folder = Path(tempfile.mkdtemp())
    command = [binary, "serve", "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--record", str(folder)]
    with served(command) as address, nesam.Client(address, timeout_s=60.0) as client:
        client.upload_map(world)
        client.open_session("truck", map_id="hills")
        steps = []
        for i in range(3):
            moved = state.copy()
            moved[:2] = 0.2 * i - 1.0, 0.0
            steps.append(nesam.Measurement("truck", i * 100_000_000, moved, (2.0, 0.0), sequence=i + 1))
        client.measure(steps)
        exported = client.export_session("truck")
        keep("session_image", "valid.bin", exported)
        keep("session_content", "valid.bin", session_image_pb2.SessionImage.FromString(exported).content)
        controls = np.tile(np.float32([2.0, 0.1]), (2, 2, 1))
        client.predict("truck", controls)
        extras = nesam.Extras(jacobians=True, covariance=True)
        for name, question in {"valid": calls.Question("truck", controls), "extras": calls.Question("truck", controls, half=True, extras=extras)}.items():
            whole = dataclasses.replace(question.call(), read=lambda reply: reply)
            keep("prediction", f"{name}.bin", client._do(whole).SerializeToString())
    keep("recording", "valid.mcap", next(folder.glob("*.mcap")).read_bytes())
    shutil.rmtree(folder)


if __name__ == "__main__":
    of_servers()
    of_a_server(sys.argv[1], *requests())
