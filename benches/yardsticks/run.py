"""One command for all yardsticks: `python run.py --nesam path/to/nesam`. Parity first, then the same queries to the server and to its peers, in turns."""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch

import peers
import report
import runtimes
from contest import Entry, Ours, contest
from drives import read_drive, read_world
from network import TerrainNetwork
from parity import compare, deviation
from rollout import Peer
from service import SESSION, candidates, drive_until, server
from terrain import ExactTokens, GivenTokens, Ground, GridTokens, in_batches
from weights import read_bundle

REPOSITORY = Path(__file__).resolve().parents[2]
ROW, HORIZON, SAMPLES, FEWER = 120, 32, 1024, 256
SETS, QUERIES, PARITY_SAMPLES, PATCHES = 8, 5, 16, 256


def say(line: str) -> None:
    """Progress, with the seconds since the program began."""
    print(f"[{time.perf_counter():7.0f}] {line}", file=sys.stderr, flush=True)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nesam", required=True, help="the nesam binary")
    parser.add_argument("--bundle", type=Path, default=REPOSITORY / "deploy/candidates/hmmwv-nominal-overspeed")
    parser.add_argument("--data", type=Path, default=REPOSITORY / "tests/data/chrono_sample", help="data root with the drive and its map")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=4, help="steps of 32 that the peers with both encoders at every pose are timed for, then scaled")
    parser.add_argument("--bf16", action="store_true", help="let the server take its products in bf16, as its peers do")
    parser.add_argument("--no-whole", action="store_true", help="leave out the whole query of the eager peer, which the scaling is held against: a minute")
    parser.add_argument("--no-compile", action="store_true", help="leave torch.compile out: it takes minutes the first time")
    parser.add_argument("--json", type=Path, help="writes all figures")
    parser.add_argument("--markdown", type=Path, help="writes the table; it is printed anyway")
    return parser.parse_args()


class Yardsticks:
    """Everything that the entries share."""

    def __init__(self, args, client, pid):
        self.args, self.bundle, self.compiled = args, read_bundle(args.bundle), not args.no_compile
        self.drive = read_drive(args.data, "nominal")
        self.world = read_world(args.data, self.drive.world)
        self.scene = drive_until(client, self.drive, self.world, ROW)
        self.client, self.ground = client, Ground(self.world, self.bundle.scales, torch.float32)
        sets = lambda samples: [candidates(self.drive, ROW, samples, HORIZON, seed) for seed in range(1, SETS + 1)]
        self.ours = Ours(client, pid, sets(SAMPLES), QUERIES)
        self.fewer = Ours(client, pid, sets(FEWER), QUERIES)
        self.agreement, self.runtime_errors = {}, {}

    def parity(self) -> dict:
        """Deviations from the server over a few candidates: f32 and f64 on the same pose grid, exact tokens, and exact tokens in bf16."""
        controls = candidates(self.drive, ROW, PARITY_SAMPLES, HORIZON, seed=100)
        found = {}
        for name, dtype in (("f32", torch.float32), ("f64", torch.float64)):
            grid, exact = compare(self.client, self.bundle, self.world, self.scene, controls, dtype)
            found[f"{name}, same pose grid"], found[f"{name}, encoders at every pose"] = grid, exact
        exact = Peer(self.bundle, self.ground).predict(self.scene, controls, ExactTokens(self.eager))
        bf16 = Peer(self.bundle, self.ground, autocast=True).predict(self.scene, controls, ExactTokens(self.tuned))
        found["bf16 against f32, encoders at every pose"] = deviation(exact, bf16)
        for name, size in found.items():
            say(f"parity, {name}: {size}")
        return {name: vars(size) for name, size in found.items()}

    def encoders(self) -> None:
        """Chooses batch and form of the encoders."""
        self.eager, self.eager_name = peers.eager_encoder(self.bundle, self.ground, self.scene, say)
        self.tuned, self.tuned_name = peers.tuned_encoder(self.bundle, self.ground, self.scene, self.compiled, say)

    def cached(self, ours: Ours) -> dict:
        """A pose grid that has seen all commands, and the tokens that it gives for the first set and for the history."""
        grid, kept = GridTokens(self.eager, self.ground), []
        plain = Peer(self.bundle, self.ground)
        for controls in ours.controls[1:]:
            plain.predict(self.scene, controls, grid)
        plain.predict(self.scene, ours.controls[0], grid, kept=kept)
        pose = (torch.tensor(self.scene.history[:, i], dtype=torch.float32) for i in (0, 1, 5))
        with torch.inference_mode():
            return {"grid": grid, "given": GivenTokens(torch.stack(kept)), "history": GivenTokens(grid.at(0, *pose)[None])}

    def entries(self) -> list:
        """All that is timed."""
        args, made = self.args, []
        for ours in (self.ours, self.fewer):
            ours.warm()
            cached, samples = self.cached(ours), ours.controls[0].shape[0]
            ways = peers.trunks(self.bundle, self.ground, self.compiled)
            best = peers.fastest_trunk(ways, self.scene, ours.controls[0], cached["given"], cached["history"], say)
            controls, scale = ours.controls[0], HORIZON / args.steps
            share = f"{args.steps} of {HORIZON} steps, scaled"
            add = lambda *parts: made.append(Entry(f"{parts[0]}, N = {samples}", *parts[1:], ours))
            check = [ways[name].predict(self.scene, ours.controls[0], cached["given"], cached["history"]) for name in ("eager f32", best)]
            self.agreement[f"{best} against eager f32, tokens given, N = {samples}"] = vars(deviation(*check))
            if samples == SAMPLES:
                at_once = in_batches(TerrainNetwork(self.bundle).eval(), self.ground, samples)
                plain = peers.exact_query(ways["eager f32"], at_once, self.scene, controls, cached["history"], args.steps)
                add("PyTorch eager, encoders at every pose", "plain", f"eager f32, all poses of a step at once; {share}", plain, scale)
                eager = peers.exact_query(ways["eager f32"], self.eager, self.scene, controls, cached["history"], args.steps)
                add("PyTorch eager, encoders at every pose, best batch", "eager", f"{self.eager_name}; {share}", eager, scale)
                self.whole = peers.exact_query(ways["eager f32"], self.eager, self.scene, controls, cached["history"], HORIZON)
                tuned_way = "compiled, bf16 Transformer" if self.compiled else "eager f32"
                tuned = peers.exact_query(ways[tuned_way], self.tuned, self.scene, controls, cached["history"], args.steps)
                add("PyTorch tuned bf16, encoders at every pose", "tuned", f"{self.tuned_name}; {tuned_way}; {share}", tuned, scale)
            for name in dict.fromkeys(("eager f32", best)):
                work = lambda peer=ways[name]: peer.predict(self.scene, controls, cached["given"], cached["history"])
                add("PyTorch, tokens given", "cached", name + (" (fastest)" if name == best else ""), work, 1.0)
            work = lambda peer=ways[best]: peer.predict(self.scene, controls, cached["grid"], cached["history"])
            add("PyTorch with the same cache, warm", "cached", best, work, 1.0)
        return made + self.terrain_entries(made)

    def terrain_entries(self, made: list) -> list:
        """Crops and the runtimes on a set of patches, scaled to the tokens of a query; torch's fastest trunk is added in the report."""
        poses = torch.tensor(self.scene.start[[0, 1, 5]], dtype=torch.float32)[:, None] + torch.randn(3, PATCHES)
        with torch.inference_mode():
            patches = torch.cat([self.ground.patches(*(p[i : i + 32] for p in poses)) for i in range(0, PATCHES, 32)])
        scale, found = SAMPLES * HORIZON / PATCHES, []
        crop = torch.inference_mode()(lambda: [self.ground.patches(*(p[i : i + 32] for p in poses)) for i in range(0, PATCHES, 32)])
        found.append(Entry("crop alone (torch)", "part", f"{PATCHES} patches, scaled", crop, scale, self.ours))
        for name, made_ready in runtimes.prepare(TerrainNetwork(self.bundle).eval(), patches.numpy(), torch.get_num_threads()).items():
            self.runtime_errors[name] = made_ready["relative_error"]
            setting = f"{made_ready['setting']}; {PATCHES} patches, scaled"
            found.append(Entry(f"terrain network, {name}", "part", setting, made_ready["run"], scale, self.ours))
            say(f"{name}: {setting}, largest relative error of a token {made_ready['relative_error']:.1e}")
        return found


def main() -> int:
    """Runs everything and prints the table."""
    args = arguments()
    torch.manual_seed(1)
    figures = {"environment": report.environment(args), "load_before": report.load()}
    with server(args.nesam, str(args.bundle), args.bf16) as (client, pid):
        yardsticks = Yardsticks(args, client, pid)
        yardsticks.encoders()
        figures["parity"] = yardsticks.parity()
        entries = yardsticks.entries()
        contest(entries, args.rounds, say)
        if not args.no_whole:
            whole = time.perf_counter()
            yardsticks.whole()
            figures["whole_eager_query_s"] = time.perf_counter() - whole
    figures["parity"].update(yardsticks.agreement)
    figures["load_after"] = report.load()
    figures["runtime_relative_error"] = yardsticks.runtime_errors
    figures["drive"] = {"trajectory": yardsticks.drive.trajectory, "world": yardsticks.world.name, "row": ROW}
    figures["ours"] = [report.of_ours(o) for o in (yardsticks.ours, yardsticks.fewer)]
    figures["peers"] = [report.of_entry(e) for e in entries]
    figures["runtimes"] = report.extrapolated(entries, yardsticks.ours)
    figures["targets"] = report.targets(figures)
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    table = report.markdown(figures)
    if args.markdown:
        args.markdown.write_text(table)
    print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
