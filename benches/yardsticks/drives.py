"""Reads recorded drives and worlds of a data root."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Optional, Tuple

import numpy as np
import pyarrow.parquet as parquet
from PIL import Image

STATE_COLUMNS = ("x", "y", "z", "roll", "pitch", "yaw", "vbx", "vby", "vbz", "wx", "wy", "wz")
COMMAND_COLUMNS = ("cmd_speed", "cmd_steer")


@dataclass(frozen=True)
class Drive:
    """A recorded drive at 10 Hz. `states`: (T, 12) f64, pose in World (m, rad), twist in Body. `commands`: (T, 2) f64, speed m/s and steering."""

    trajectory: str
    world: str
    states: np.ndarray
    commands: np.ndarray


@dataclass(frozen=True)
class World:
    """A map, row 0 in the south. `elevation_m`: (height, width) f32. `rgb`: (height, width, 3) uint8. `origin_m`: World position of cell (0, 0)."""

    name: str
    elevation_m: np.ndarray
    rgb: np.ndarray
    origin_m: Tuple[float, float]
    resolution_m: float


def read_drive(root: Path, name: str, trajectory: Optional[str] = None) -> Drive:
    """Reads a drive of the set `name`; without a trajectory the first one of the test split."""
    index = json.loads((root / name / "index.json").read_text())
    row = next(r for r in index if (r["trajectory"] == trajectory if trajectory else r["split"] == "test"))
    columns = ["t", *STATE_COLUMNS, *COMMAND_COLUMNS]
    table = parquet.read_table(root / name / "samples.parquet", columns=columns, filters=[("trajectory", "=", row["trajectory"])])
    t = table.column("t").to_numpy()
    if not np.allclose(np.diff(t), 0.1, atol=1e-3):
        raise ValueError(f"{row['trajectory']} is not sampled at 10 Hz")
    take = lambda names: np.stack([table.column(c).to_numpy().astype(np.float64) for c in names], axis=1)
    return Drive(row["trajectory"], row["world"], take(STATE_COLUMNS), take(COMMAND_COLUMNS))


def read_world(root: Path, name: str) -> World:
    """Reads a world folder: heights are offset + scale * pixel, images have their north row first."""
    folder = root / "worlds" / name
    world = json.loads((folder / "world.json").read_text())
    gray = np.asarray(Image.open(folder / world["elevation"]["file"])).astype(np.float64)
    elevation = (world["elevation"]["offset_m"] + world["elevation"]["scale_m"] * gray).astype(np.float32)
    rgb = np.asarray(Image.open(folder / world["semantic"]["file"]).convert("RGB"))
    return World(name, elevation[::-1].copy(), rgb[::-1].copy(), tuple(world["origin_m"]), world["resolution_m"])
