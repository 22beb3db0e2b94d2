"""The figures of a run as JSON and as a table."""

import os
import platform
import statistics
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import List

import torch

from contest import Entry, Ours

PACKAGES = ("torch", "onnxruntime", "openvino", "numpy")
TARGETS = {"eager": 700.0, "tuned": 400.0, "cached": 10.0}


def environment(args) -> dict:
    """What it ran on and with."""
    cpu = [line.split(":", 1)[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    flags = Path("/proc/cpuinfo").read_text()
    return {
        "processor": cpu[0] if cpu else platform.processor(),
        "processors": os.cpu_count(),
        "instructions": [name for name in ("avx2", "avx512f", "avx512_bf16", "amx_bf16") if f" {name}" in flags],
        "threads": torch.get_num_threads(),
        "nesam": subprocess.run([args.nesam, "--version"], capture_output=True, text=True).stdout.split("\n")[0],
        "bundle": args.bundle.name,
        "python": platform.python_version(),
        **{name: installed(name) for name in PACKAGES},
        "bf16": args.bf16,
        "niceness": os.nice(0),
        "rounds": args.rounds,
    }


def installed(package: str) -> str:
    """Version of a package, or that it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def load() -> list:
    """Mean number of processes that wanted a processor over the last 1, 5 and 15 minutes."""
    return [round(x, 1) for x in os.getloadavg()]


def of_ours(ours: Ours) -> dict:
    """Figures of the server."""
    samples, horizon = ours.controls[0].shape[:2]
    wall = sorted(ours.wall_s)
    return {
        "samples": samples,
        "horizon": horizon,
        "queries": len(wall),
        "p50_s": statistics.median(wall),
        "p90_s": wall[int(0.9 * (len(wall) - 1))],
        "fastest_s": wall[0],
        "processor_s": statistics.median(ours.processor_s),
    }


def of_entry(entry: Entry) -> dict:
    """Figures of a peer, scaled to a whole query; `ratio` against the queries just before and after."""
    return {
        "name": entry.name,
        "kind": entry.kind,
        "setting": entry.setting,
        "scale": entry.scale,
        "wall_s": entry.wall_s,
        "median_s": statistics.median(entry.wall_s),
        "processor_s": statistics.median(entry.processor_s),
        "ratio": statistics.median(entry.ratio),
        "ratios": entry.ratio,
        "ratio_of_fastest": min(entry.wall_s) / min(entry.ours.wall_s),
    }


def extrapolated(entries: List[Entry], ours: Ours) -> list:
    """Queries of the runtimes: tokens x (crop + network) as timed on patches, plus the fastest torch trunk with its physics. Round by round."""
    crop = next(e for e in entries if e.name.startswith("crop"))
    trunk = min((e for e in entries if e.ours is ours and e.name.startswith("PyTorch, tokens given")), key=lambda e: statistics.median(e.wall_s))
    found, poses = [], ours.controls[0].shape[0] * ours.controls[0].shape[1]
    for entry in (e for e in entries if e.name.startswith("terrain network")):
        parts = list(zip(entry.wall_s, crop.wall_s, trunk.wall_s))
        ratios = [sum(r) for r in zip(entry.ratio, crop.ratio, trunk.ratio)]
        name = entry.name.removeprefix("terrain network, ")
        precise = {"median_s": statistics.median(map(sum, parts)), "ratio": statistics.median(ratios), "ratios": ratios}
        fastest = sum(min(e.wall_s) for e in (entry, crop, trunk))
        per_pose = {"network_us": statistics.median(entry.wall_s) / poses * 1e6, "crop_us": statistics.median(crop.wall_s) / poses * 1e6}
        found.append({"name": name, "setting": entry.setting, **per_pose, **precise, "ratio_of_fastest": fastest / min(ours.wall_s)})
    return found


def targets(figures: dict) -> dict:
    """The three ratios that were asked for, at 1024 candidates, and whether they hold: by the median of the rounds."""
    found = {}
    for kind, target in TARGETS.items():
        ratios = [p["ratio"] for p in figures["peers"] if p["kind"] == kind and p["name"].endswith("1024")]
        if ratios:
            found[kind] = {"target": target, "measured": min(ratios), "holds": min(ratios) >= target}
    return found


def span(ratios: list) -> str:
    """Lowest to highest."""
    return f"{min(ratios):.3g}–{max(ratios):.3g}"


def markdown(figures: dict) -> str:
    """The table, what it ran on, and the targets."""
    env, ours = figures["environment"], figures["ours"]
    packages = ", ".join(f"{name} {env[name]}" for name in PACKAGES)
    has = " ".join(env["instructions"])
    lines = [
        f"{env['processor']}, {env['processors']} processors ({has}), {env['threads']} threads each; {env['nesam']}{' in bf16' if env['bf16'] else ''}, bundle {env['bundle']}; {packages}; "
        f"load {figures['load_before'][0]} before, {figures['load_after'][0]} after; niceness {env['niceness']}; {env['rounds']} rounds.",
        "",
        "| 32 steps | how | median s | processor s | times ours (rounds) | fastest over fastest |",
        "|---|---|---|---|---|---|",
    ]
    for o in ours:
        how = f"over gRPC, pose grid warm; p50 of {o['queries']} queries, p90 {o['p90_s']:.3f} s, fastest {o['fastest_s']:.3f} s"
        lines.append(f"| **nesam, N = {o['samples']}** | {how} | **{o['p50_s']:.3f}** | {o['processor_s']:.2f} | 1 | 1 |")
    for p in figures["peers"]:
        if p["kind"] != "part":
            ratio = f"**{p['ratio']:.3g}** ({span(p['ratios'])})"
            figuresof = f"{p['median_s']:.3g} | {p['processor_s']:.3g} | {ratio} | {p['ratio_of_fastest']:.3g}"
            lines.append(f"| {p['name']} | {p['setting']} | {figuresof} |")
    for r in figures["runtimes"]:
        how = f"{r['setting']}; 32 768 × (torch crop {r['crop_us']:.0f} µs + network {r['network_us']:.0f} µs) + fastest torch trunk"
        ratio = f"**{r['ratio']:.3g}** ({span(r['ratios'])})"
        lines.append(f"| {r['name']}, encoders at every pose, N = 1024, extrapolated | {how} | {r['median_s']:.3g} | | {ratio} | {r['ratio_of_fastest']:.3g} |")
    if "whole_eager_query_s" in figures:
        lines += ["", f"Scaling held against one whole query of the eager peer with the best batch, after the rounds: {figures['whole_eager_query_s']:.1f} s."]
    lines += ["", "| target | asked | measured | holds |", "|---|---|---|---|"]
    names = {"eager": "PyTorch eager, best batch", "tuned": "tuned bf16", "cached": "the same terrain cache (fastest such peer)"}
    for kind, t in figures["targets"].items():
        lines.append(f"| {names[kind]} | ≥ {t['target']:.0f} | {t['measured']:.3g} | {'yes' if t['holds'] else 'no'} |")
    lines += ["", "| largest deviation | position m | z m | roll, pitch rad | yaw rad |", "|---|---|---|---|---|"]
    for name, d in figures["parity"].items():
        lines.append(f"| {name} | {d['position_m']:.1e} | {d['z_m']:.1e} | {d['tilt_rad']:.1e} | {d['yaw_rad']:.1e} |")
    return "\n".join(lines) + "\n"
