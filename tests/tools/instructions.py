"""Counts the instructions of what the service does over and over, and holds them against the counts that are committed.

    tests/tools/instructions.py target/release/counted            compare; exit 1 where one has grown by more than the tolerance
    tests/tools/instructions.py target/release/counted --write    what is counted now is what is meant

Times on a shared machine scatter by a third, counts by next to nothing, so that a slip of a few per cent shows. Each piece of work is done under valgrind,
on one thread, and only its own instructions are counted. Valgrind knows AVX2 and no AVX-512, so the AVX2 path is counted on every machine. Exit 2: no
valgrind here, or one that does not know an instruction (3.19 lacks `vmovq` from one of xmm8 to xmm15 to one of xmm0 to xmm7, which a compiler takes
where the first half of a register is all that is used).
"""

import argparse
import concurrent.futures
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys

COUNTS = pathlib.Path(__file__).resolve().parents[2] / "benches/instructions.json"
#: Repetitions that are counted.
TIMES = 2
#: Growth that is let pass: what a linker or a math library of another build may move.
TOLERANCE = 0.03


def count(program: str, work: str) -> int | None:
    """Instructions of one repetition; None where valgrind does not know one of them."""
    command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", "--toggle-collect=*counted_work*", program, work, str(TIMES)]
    environment = {**os.environ, "RAYON_NUM_THREADS": "1"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if "Unrecognised instruction" in run.stderr:
        return None
    counted = re.search(r"Collected : (\d+)", run.stderr)
    if run.returncode != 0 or counted is None or int(counted[1]) == 0:
        sys.exit(f"{' '.join(command)} ended with {run.returncode}:\n{run.stderr}")
    return int(counted[1]) // TIMES


def main() -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="the program `counted` of the benches")
    parser.add_argument("--write", action="store_true", help="commit to what is counted now")
    arguments = parser.parse_args()
    if shutil.which("valgrind") is None:
        print("no valgrind here (Debian: valgrind): instructions are not counted")
        return 2
    works = subprocess.run([arguments.program], capture_output=True, text=True, check=True).stdout.split()
    with concurrent.futures.ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        counts = dict(zip(works, pool.map(lambda work: count(arguments.program, work), works)))
    unknown = [work for work, counted in counts.items() if counted is None]
    counts = {work: counted for work, counted in counts.items() if counted is not None}
    if arguments.write:
        if unknown:
            sys.exit(f"valgrind does not know an instruction of {', '.join(unknown)}: nothing is written")
        COUNTS.write_text(json.dumps(counts, indent=2) + "\n")
    meant = json.loads(COUNTS.read_text())
    grown = False
    print(f"{'work':24} {'instructions':>14} {'meant':>14} {'ratio':>7}")
    for work, now in counts.items():
        before = meant.get(work)
        if before is None:
            print(f"{work:24} {now:14} {'-':>14}  not committed: --write")
            grown = True
            continue
        ratio = now / before
        verdict = "GREW" if ratio > 1 + TOLERANCE else "fell: --write keeps it" if ratio < 1 - TOLERANCE else ""
        grown |= ratio > 1 + TOLERANCE
        print(f"{work:24} {now:14} {before:14} {ratio:7.3f} {verdict}")
    for work in unknown:
        print(f"{work:24} valgrind does not know an instruction of it: not counted")
    return 1 if grown else 2 if unknown else 0


if __name__ == "__main__":
    sys.exit(main())
