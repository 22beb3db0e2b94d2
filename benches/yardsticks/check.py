"""Parity alone: `python check.py --nesam path/to/nesam`. Exit code 1 when peer and server disagree by more than a millimetre on the same pose grid."""

import argparse
import sys
from pathlib import Path

import torch

from drives import read_drive, read_world
from parity import compare
from service import candidates, drive_until, server
from weights import read_bundle

REPOSITORY = Path(__file__).resolve().parents[2]
HORIZON = 32
LIMIT_M = 1e-3


def main() -> int:
    """Runs the check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nesam", required=True, help="the nesam binary")
    parser.add_argument("--bundle", type=Path, default=REPOSITORY / "deploy/candidates/hmmwv-nominal-overspeed")
    parser.add_argument("--set", default="nominal", help="set of the repository's sample")
    parser.add_argument("--trajectory", help="drive [default: the first of the test split]")
    parser.add_argument("--row", type=int, default=120, help="row of the drive to start from, at least 31")
    parser.add_argument("--samples", type=int, default=4, help="candidates")
    args = parser.parse_args()
    bundle, root = read_bundle(args.bundle), REPOSITORY / "tests/data/chrono_sample"
    drive = read_drive(root, args.set, args.trajectory)
    world = read_world(root, drive.world)
    controls = candidates(drive, args.row, args.samples, HORIZON, seed=1)
    with server(args.nesam, str(args.bundle)) as (client, _):
        scene = drive_until(client, drive, world, args.row)
        grid, exact = compare(client, bundle, world, scene, controls, torch.float32)
    print(f"on the same pose grid:          {grid}")
    print(f"both encoders at every pose:    {exact}")
    return int(not grid.position_m <= LIMIT_M)


if __name__ == "__main__":
    sys.exit(main())
