#!/usr/bin/env python3
"""Looks at the reports of `evaluate`, `adapt`, `diagnose`, `navigate`, `bench` and `import` in a headless Chromium, as a person would: reports.py path/to/nesam [--shots DIR]

Goal: one look; nothing is loaded from elsewhere; every plot says its values under the pointer; every table can be copied; command and versions stand at the bottom.
Method: the real binary makes each report of the committed sample with small settings; the page is asked what it shows. Without a Chromium it says so and passes.
"""

import argparse
import pathlib
import subprocess
import sys
import tempfile
import time

import browser

ROOT = pathlib.Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "tests/data/chrono_sample"
CARD = SAMPLE / "vehicle_hmmwv.json"
DATA = ["--data", str(SAMPLE)]
REPORTS = {
    "evaluate": ["evaluate", *DATA, "--set", "nominal", "--models", "nesam,kinematic,constant_velocity", "--resamples", "1000"],
    "adapt": ["adapt", *DATA, "--set", "ood_soil"],
    "diagnose": ["diagnose", *DATA, "--set", "effect_open/steer_offset", "--no-controls"],
    "navigate": ["navigate", *DATA, "--worlds", "w35", "--runs", "1", "--configurations", "kinematic", "--candidates", "8", "--horizon", "10", "--plan-every", "10"],
    "bench": ["bench", "predict", "--samples", "16", "--queries", "2", "--sweep"],
    "import": ["import", str(ROOT / "docs/example/run.csv"), "--to", "mine", "--set", "first", "--vehicle", str(CARD)],
}

HOVER = """[...document.querySelectorAll('svg.plot')].map(plot => {
  plot.scrollIntoView({ block: 'center' });
  const box = plot.getBoundingClientRect(), at = { clientX: box.x + .6 * box.width, clientY: box.y + .5 * box.height, bubbles: true };
  plot.dispatchEvent(new PointerEvent('pointermove', at));
  const note = document.getElementById('note'), said = note.hidden ? '' : note.innerText;
  plot.dispatchEvent(new PointerEvent('pointerleave'));
  return said;
})"""
TABLES = "[...document.querySelectorAll('button[data-copy]')].map(b => [b.nextElementSibling.rows.length, b.nextElementSibling.rows[0].cells.length])"
# Where a button is, after it was moved into the window.
PLACE = """(i => { const b = document.querySelectorAll('button[data-copy]')[i]; b.scrollIntoView({ block: 'center' });
  const r = b.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })(%d)"""
SAID = "document.querySelectorAll('button[data-copy]')[%d].textContent"
LOOK = """(() => { const s = getComputedStyle(document.body), h = getComputedStyle(document.querySelector('h1'));
  return [s.fontFamily, s.fontSize, s.backgroundColor, s.color, h.fontSize, getComputedStyle(document.querySelector('main')).maxWidth]; })()"""


def make(binary, folder):
    """Paths of the reports by name."""
    for name, arguments in REPORTS.items():
        done = subprocess.run([binary, *arguments, "--html", f"{name}.html"], cwd=folder, capture_output=True, text=True, timeout=400)
        if done.returncode:
            sys.exit(f"nesam {' '.join(arguments)}:\n{done.stdout}{done.stderr}")
    return {name: folder / f"{name}.html" for name in REPORTS}


class Report:
    """A page that is open, and what it must keep to."""

    def __init__(self, chromium, name, path):
        self.chromium, self.name, self.ask = chromium, name, chromium.value
        chromium.open(path.as_uri())
        chromium.wait("document.readyState === 'complete' && !!document.getElementById('note')", 20)

    def copied(self, i):
        """What the button of table `i` puts into the clipboard, clicked with the mouse."""
        self.ask("navigator.clipboard.writeText('nothing yet')")
        self.chromium.click_at(*self.ask(PLACE % i))
        until = time.monotonic() + 1.0
        while (said := self.ask(SAID % i)) == "copy table" and time.monotonic() < until:
            time.sleep(0.02)
        assert said == "copied", f"{self.name}: the button of table {i} says `{said}`"
        return self.ask("navigator.clipboard.readText()")

    def check(self):
        name = self.name
        said = self.ask(HOVER)
        assert all(any(c.isdigit() for c in one) for one in said), f"{name}: a plot says nothing under the pointer: {said}"
        assert said, f"{name}: no plot"
        tables = self.ask(TABLES)
        # An import has nothing to tabulate.
        assert tables or name == "import", f"{name}: no table"
        for i, (rows, columns) in enumerate(tables):
            lines = self.copied(i).split("\n")
            assert len(lines) == rows and all(line.count("\t") == columns - 1 for line in lines), f"{name}: copied {lines[:3]} of {rows} rows"
        footer = self.ask("document.querySelector('footer').innerText")
        command = self.ask("[...document.querySelectorAll('footer dt')].find(t => t.textContent === 'command').nextElementSibling.textContent")
        assert command.startswith("nesam " + REPORTS[name][0]), f"{name}: {command}"
        assert "nesam 0." in footer, f"{name}: no version can be read at the bottom: {footer}"
        assert self.ask("performance.getEntriesByType('resource').length") == 0, f"{name}: loads something"
        assert not self.ask("document.documentElement.scrollWidth > innerWidth"), f"{name}: wider than its window"
        assert not self.chromium.errors, f"{name}: {self.chromium.errors}"
        return len(said), len(tables), self.ask(LOOK)


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("binary", type=pathlib.Path)
    arguments.add_argument("--shots", type=pathlib.Path, help="folder for a picture of each report")
    given = arguments.parse_args()
    if not browser.find():
        print("no Chromium here: the reports are not looked at")
        return
    with tempfile.TemporaryDirectory() as folder, browser.Browser() as chromium:
        chromium.call("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
        # As in a window that somebody works in.
        chromium.call("Emulation.setFocusEmulationEnabled", enabled=True)
        looks = {}
        for name, path in make(given.binary.resolve(), pathlib.Path(folder)).items():
            chromium.look(1200, 900)
            report = Report(chromium, name, path)
            plots, tables, looks[name] = report.check()
            print(f"{name}: {plots} plots, {tables} tables copied")
            if given.shots:
                given.shots.mkdir(parents=True, exist_ok=True)
                chromium.screenshot(given.shots / f"{name}.png", whole=True)
        assert len({tuple(look) for look in looks.values()}) == 1, f"not one look: {looks}"
    print(f"{len(REPORTS)} reports looked at")


if __name__ == "__main__":
    main()
