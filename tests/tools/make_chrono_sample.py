#!/usr/bin/env python3
"""Cuts the committed sample out of the full Chrono data root.

The sample has the layout of a data root: vehicle card, a few worlds, a folder per set, all columns (ground truth included, for
the demonstrations of `evaluate`), but only a handful of drives, so that demo and tests work on a fresh clone.

    python3 tests/tools/make_chrono_sample.py --source DATA_ROOT --out tests/data/chrono_sample

Needs pyarrow. The choice is fixed below; the same source gives the same sample. Drives were chosen by their description in the
index alone (full length, one per frequency mode), before any model was run on them.
"""

import argparse
import hashlib
import json
import pathlib
import shutil

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

# Set -> list of (world, split, how many drives).
CHOICE = {
    "nominal": [("w05", "test", 2), ("w16", "test", 2), ("w01", "train", 2)],
    "ood_soil": [("w35", "test", 1)],
    "effect_open/steer_offset": [("w25", "test", 1), ("w26", "test", 1)],
    "effect_open/null_open": [("w25", "test", 1), ("w26", "test", 1)],
}
SAMPLES, INDEX = "samples.parquet", "index.parquet"


def choose(index, wanted):
    """The first full-length drives of each world and split, alternating between the frequency modes."""
    chosen = []
    for world, split, count in wanted:
        rows = [r for r in index if r["world"] == world and r["split"] == split and r["end"] in ("complete", "path_end")]
        rows.sort(key=lambda r: r["trajectory"])
        modes = sorted({r["freq_mode"] for r in rows}, reverse=True)
        by_mode = {m: [r for r in rows if r["freq_mode"] == m] for m in modes}
        picked = []
        while len(picked) < count and any(by_mode.values()):
            for mode in modes:
                if by_mode[mode] and len(picked) < count:
                    picked.append(by_mode[mode].pop(0))
        if len(picked) < count:
            raise SystemExit(f"only {len(picked)} of {count} drives on {world}/{split}")
        chosen += picked
    return sorted(r["trajectory"] for r in chosen)


def cut_set(source, out, name, wanted):
    """Writes the chosen drives of one set; returns the worlds they need."""
    index = pq.read_table(source / name / INDEX)
    ids = pa.array(choose(index.to_pylist(), wanted))
    keep = lambda table: table.filter(pc.is_in(table["trajectory"].cast(pa.string()), value_set=ids))
    index = keep(index)
    folder = out / name
    folder.mkdir(parents=True)
    options = {"compression": "zstd", "compression_level": 19}
    pq.write_table(keep(pq.read_table(source / name / SAMPLES)), folder / SAMPLES, **options)
    pq.write_table(index, folder / INDEX, **options)
    (folder / "index.json").write_text(json.dumps(index.to_pylist(), separators=(",", ":")) + "\n")
    return set(index["world"].to_pylist()), index.to_pylist()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=pathlib.Path, required=True, help="the full data root")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write; replaced if it is there")
    args = parser.parse_args()
    if args.out.exists():
        shutil.rmtree(args.out)
    args.out.mkdir(parents=True)

    worlds, drives = set(), []
    for name, wanted in CHOICE.items():
        needs, rows = cut_set(args.source, args.out, name, wanted)
        worlds |= needs
        drives += [(name, r["trajectory"], r["world"], r["split"], r["n_samples"]) for r in rows]
    for card in sorted(args.source.glob("vehicle_*.json")):
        shutil.copyfile(card, args.out / card.name)
    for world in sorted(worlds):
        (args.out / "worlds" / world).mkdir(parents=True)
        for file in sorted((args.source / "worlds" / world).iterdir()):
            shutil.copyfile(file, args.out / "worlds" / world / file.name)

    files = sorted(p for p in args.out.rglob("*") if p.is_file())
    digest = lambda path: hashlib.sha256(path.read_bytes()).hexdigest()
    lines = [
        "# Sample of the Chrono drives",
        "",
        "A data root with a few drives of a HMMWV on deformable soil, simulated with Project Chrono's SCM soil contact model, so",
        "that demo and tests work on a fresh clone. Columns without `gt_` carry sensor noise and are what the model sees; `gt_`",
        "columns and files are ground truth, for evaluation only. Figures that are worth quoting need the full data (`--data`).",
        "",
        "Made from the full data root by",
        "",
        "    python3 tests/tools/make_chrono_sample.py --source DATA_ROOT --out tests/data/chrono_sample",
        "",
        "| set | trajectory | world | split | samples |",
        "|---|---|---|---|---|",
        *(f"| {' | '.join(str(v) for v in drive)} |" for drive in drives),
        "",
        f"{sum(p.stat().st_size for p in files) / 1e6:.1f} MB. SHA-256:",
        "",
        *(f"    {digest(p)}  {p.relative_to(args.out).as_posix()}" for p in files),
    ]
    (args.out / "README.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
