#!/usr/bin/env python3
"""Writes the reference pages of the book from what they describe: reference.py path/to/nesam [--check]

docs/api.md from the comments in proto/, docs/configuration.md from those in deploy/config/default.toml, docs/metrics.md from what a server with everything switched
on says at /metrics. With --check nothing is written; exit code 1 where a page is stale.
"""

import argparse
import pathlib
import re
import sys
import tempfile
import urllib.request

from serving import served

ROOT = pathlib.Path(__file__).resolve().parents[2]
MADE = "Made by `tests/tools/reference.py`; a test fails when it is stale."


def cell(text):
    return re.sub(r"\s+", " ", text).strip().replace("|", "\\|").replace("<", "&lt;")


def api():
    """The services of nesam.v1 by the comments in their files."""
    page = ["# Services and methods", "",
            f"Package `nesam.v1`, over gRPC. {MADE} Fields, their units and limits stand beside them in `proto/nesam/v1/*.proto`; a running server tells all by reflection "
            "(`grpc.reflection`), and how it is by `grpc.health.v1`. What the clients make of it: [Python](tutorial.md), [planners](planner.md).", ""]
    for path in sorted((ROOT / "proto/nesam/v1").glob("*.proto")):
        comment, service = [], False
        for line in path.read_text(encoding="utf-8").splitlines():
            line = line.strip()
            if line.startswith("//"):
                comment.append(line[2:].strip())
                continue
            begins = re.match(r"service (\w+) \{", line)
            method = re.match(r"rpc (\w+)\((stream )?(\w+)\) returns \((stream )?(\w+)\)", line)
            if begins:
                service = True
                page += [f"## {begins[1]}", "", cell(" ".join(comment)) or f"`{path.relative_to(ROOT)}`", "", "| method | asked with | answered with | what |", "|---|---|---|---|"]
            elif service and method:
                asks, answers = (("stream of " if s else "") + f"`{m}`" for s, m in ((method[2], method[3]), (method[4], method[5])))
                page.append(f"| `{method[1]}` | {asks} | {answers} | {cell(' '.join(comment))} |")
            comment = []
        if service:
            page.append("")
    return "\n".join(page)


def configuration():
    """The settings of `nesam serve`, by section."""
    page = ["# Configuration", "",
            f"What a file for `nesam serve --config` may hold, with the defaults. {MADE} A file may leave out any key; unknown keys are refused, and `nesam serve --config FILE --check` says what is wrong. "
            "Options of the command line go before the file. `deploy/config/default.toml` has the same as a file.", ""]
    comment = []
    for line in (ROOT / "deploy/config/default.toml").read_text(encoding="utf-8").splitlines():
        section, key = re.match(r"\[([\w.]+)\]", line), re.match(r"([a-z_0-9]+) = (.*)", line)
        if line.startswith("#"):
            comment.append(line[1:].strip())
        elif section:
            page += ["", f"## `[{section[1]}]`", ""]
            comment = []
        elif key:
            if not page[-1].startswith("|"):
                page += ["| key | default | what |", "|---|---|---|"]
            page.append(f"| `{key[1]}` | `{cell(key[2])}` | {cell(' '.join(comment))} |")
            comment = []
        elif not line.strip():
            comment = []
    return re.sub(r"\n{3,}", "\n\n", "\n".join(page)) + "\n"


def told_by_a_server(binary):
    """What /metrics says with store, recording, soil of the fleet, Zenoh and ROS 2 switched on."""
    with tempfile.TemporaryDirectory() as folder:
        (pathlib.Path(folder) / "nesam.toml").write_text("[fleet_soil]\nenabled = true\n[ros2]\nenabled = true\n")
        ports = ["--grpc", "127.0.0.1:0", "--http", "127.0.0.1:0", "--zenoh-listen", "tcp/127.0.0.1:0"]
        command = [binary, "serve", "--config", "nesam.toml", *ports, "--store", "store", "--record", "run"]
        with served(command, "http", folder) as address:
            return urllib.request.urlopen(f"{address.rstrip('/')}/metrics", timeout=30).read().decode()


def metrics(binary):
    """The metrics by name."""
    helps, kinds = {}, {}
    for line in told_by_a_server(binary).splitlines():
        said = re.match(r"# (HELP|TYPE) (\w+) (.*)", line)
        if said:
            (helps if said[1] == "HELP" else kinds)[said[2]] = said[3]
    page = ["# Metrics", "",
            f"What `nesam serve` says at `/metrics` in the format of Prometheus. {MADE} Rules of alerts are in `deploy/prometheus/rules.yaml`, a board in `deploy/grafana/nesam.json`. "
            "The unit is the end of the name.", "", "| metric | kind | what |", "|---|---|---|"]
    page += [f"| `{name}` | {kinds.get(name, '')} | {cell(helps[name])} |" for name in sorted(helps)]
    return "\n".join(page) + "\n"


def pages(binary):
    return {"api.md": api(), "configuration.md": configuration(), "metrics.md": metrics(binary)}


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("binary", type=lambda text: pathlib.Path(text).resolve())
    arguments.add_argument("--check", action="store_true", help="write nothing; say which pages are stale")
    given = arguments.parse_args()
    stale = 0
    for name, text in pages(given.binary).items():
        path = ROOT / "docs" / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            stale += 1
            print(f"docs/{name}: {'stale' if given.check else 'written'}")
            if not given.check:
                path.write_text(text, encoding="utf-8")
    return int(given.check and stale > 0)


if __name__ == "__main__":
    sys.exit(main())
