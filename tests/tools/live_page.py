#!/usr/bin/env python3
"""Drives the live page in a headless Chromium against the real server: `live_page.py NESAM [--shots DIR]`.

Goal: the page comes alive with real data, also behind a proxy below a path of its own, says what to do when there is none, and can be used with the keyboard, on a laptop and a tablet, in light and
dark. Method: `nesam serve` without vehicles, then `nesam demo`, which plays a recorded drive; what is asserted is what a person would see.
Prints `skipped: no chromium` and ends well where there is none.
"""

import http.client
import http.server
import json
import pathlib
import re
import subprocess
import sys
import tempfile
import threading
import time

from browser import Browser, find

SIZES = {"laptop": (1440, 900), "tablet": (820, 1180)}
REPORT = {
    "schema": "nesam.diagnose/1", "set": "mine/steering", "verdict": "explained", "reason": "", "fit_on": ["a"], "held_out": ["b", "c"],
    "effects": [{"id": "steering_offset", "weight": 1.0, "parameters": [{"name": "second", "unit": "-", "value": 0.12, "ci95": [0.11, 0.13]}],
                 "onset_s": None, "evidence": {"z": 9.0}, "rivals": [{"id": "gyro_bias", "weight": 0.1}]}],
    "before": {"mae_mean": {"yaw_deg": 5.0}, "position_m": {"mean": 0.8}, "ci95": {"position_m": {"mean": [0.7, 0.9]}}},
    "soil_only": {"mae_mean": {"yaw_deg": 4.9}, "position_m": {"mean": 0.7}, "ci95": {}},
    "after": {"mae_mean": {"yaw_deg": 1.0}, "position_m": {"mean": 0.2}, "ci95": {}},
    "improvement_ci95": {"position_m": {"mean": [-0.6, -0.4]}},
}
CONTRAST = """(() => {
  const value = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const light = (hex) => { const [r, g, b] = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const ratio = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + 0.05) / (y + 0.05); };
  return Object.fromEntries(["--ink", "--soft", "--vermilion", "--blue"].map((name) => [name, ratio(value(name), value("--panel"))]));
})()"""
NAMELESS = "[...document.querySelectorAll('button, canvas, svg[role=img], section')].filter((e) => !(e.ariaLabel || e.getAttribute('aria-labelledby') || e.textContent.trim())).length"
FOREIGN = "performance.getEntriesByType('resource').filter((e) => !e.name.startsWith(location.origin) && !e.name.startsWith('data:')).map((e) => e.name)"
PAINTED = """(() => { const c = document.querySelector('#map'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, seen = new Set();
  for (let i = 0; i < d.length; i += 4 * 97) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return seen.size; })()"""

RATES = """(async () => {
  const { Store } = await import("/store.js"), store = new Store();
  for (let i = 1; i <= 240; i++) {
    const timings = Array.from({ length: 50 }, () => [i / 8, 0.1, 2, 64]);
    store.apply({ now_s: i / 8, service: { predictions: 50 * i }, alarms: [], sessions: [], timings });
  }
  return [store.rate("predictions"), store.rate("candidates"), store.timings.length, store.now - store.timings[0][0]];
})()"""
BESIDE_A_HOLE = """(async () => {
  const { Ground } = await import("/ground.js"), ground = new Ground("m", "a");
  Object.assign(ground, { about: { columns: 5, rows: 5, resolution_m: 1, height_range_m: [0, 1] }, contour_m: 0.1, heights: new Float32Array(25).fill(0.55) });
  ground.heights[12] = NaN;
  const { data } = ground.paint("elevation", false).getContext("2d").getImageData(0, 0, 5, 5);
  return [...new Set(Array.from({ length: 25 }, (_, i) => (data[4 * i + 3] ? data[4 * i] : "hole")))].length;
})()"""
CONTOURS = """(async () => {
  const { Ground } = await import("/ground.js"), ground = new Ground("m", "a");
  Object.assign(ground, { about: { origin_m: [10, 20], columns: 5, rows: 5, resolution_m: 1 }, contour_m: 0.5 });
  const lines = (height, every) => {
    ground.heights = Float32Array.from({ length: 25 }, (_, i) => height(i % 5, Math.floor(i / 5)));
    const pieces = ground.contours([0, 0], [99, 99], every), points = Array.from({ length: pieces.length / 2 }, (_, i) => [pieces[2 * i] - 10, pieces[2 * i + 1] - 20]);
    return [points.length / 2, points.every(([x, y]) => Math.abs(height(x, y) / 0.5 - Math.round(height(x, y) / 0.5)) < 1e-5)];
  };
  const slope = (x, y) => 0.3 * x + 1e-3 * y;
  return [lines(slope, 1), lines(slope, 2), lines((x, y) => (x === 2 && y === 2 ? NaN : slope(x, y)), 1)[0], lines(() => 0.5, 1)[0]];
})()"""
LOADS = """(async () => {
  const { MapView } = await import("/map.js"), map = { id: "m", version: 1, hash: "a" };
  const view = Object.assign(Object.create(MapView.prototype), { store: { session: { map } }, grounds: new Map(), notBefore: new Map(), changed() {} });
  const about = { origin_m: [0, 0], resolution_m: 1, columns: 1, rows: 1, height_range_m: [0, 1], semantics: false, classes: [] };
  const fetched = window.fetch, told = [];
  let fails = true, asked = 0;
  window.fetch = async (url) => {
    asked += 1;
    return fails ? new Response("busy", { status: 503 }) : url.endsWith("/elevation") ? new Response(new Uint8Array(2)) : Response.json(about);
  };
  const look = async (ms) => {
    view.fetchGround();
    await new Promise((resolve) => setTimeout(resolve, ms));
    told.push([asked, view.ground?.hash ?? null]);
  };
  await look(100);
  fails = false;
  await look(2100);
  await look(100);
  await look(100);
  map.hash = "b";
  await look(100);
  window.fetch = fetched;
  return told;
})()"""


class Program:
    """A running `nesam`, and the address of its page."""

    def __init__(self, *args):
        self.process = subprocess.Popen([*args], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        for line in self.process.stdout:
            found = re.search(r"(?:http |watch )\s*(http://[0-9.:]+/)", line)
            if found:
                self.url = found.group(1)
                # What it prints is read on, or it would wait for us one day.
                threading.Thread(target=self.process.stdout.read, daemon=True).start()
                return
        raise AssertionError(f"{args} ended without saying where its page is")

    def stop(self):
        self.process.terminate()
        self.process.wait(60)


class Proxy:
    """Passes on what is asked below /fleet/, without that path, and nothing else. Use as a context manager."""

    def __init__(self, url):
        self.host = re.sub(r"http://|/", "", url)

    def __enter__(self):
        host = self.host

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                if not self.path.startswith("/fleet/"):
                    return self.send_error(404)
                behind = http.client.HTTPConnection(host, timeout=60)
                behind.request("GET", self.path.removeprefix("/fleet"))
                answer = behind.getresponse()
                self.send_response(answer.status)
                for name in ("content-type", "content-security-policy"):
                    if answer.getheader(name):
                        self.send_header(name, answer.getheader(name))
                self.end_headers()
                try:
                    while part := answer.read1(1 << 16):
                        self.wfile.write(part)
                        self.wfile.flush()
                except OSError:
                    pass  # the page or the service has gone

            def log_message(self, *_):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{self.server.server_address[1]}/fleet/"

    def __exit__(self, *_):
        self.server.shutdown()


def becomes(browser, element, pressed=True):
    """Whether a button is or is not pressed within seconds: the page draws when the browser has time."""
    try:
        browser.wait(f"document.getElementById('{element}').getAttribute('aria-pressed') === '{str(pressed).lower()}'", 30)
    except AssertionError:
        return False
    return True


def text(browser, selector):
    return browser.value(f"document.querySelector({json.dumps(selector)}).innerText")


def check(condition, what):
    if not condition:
        raise AssertionError(what)
    print(f"  {what}")


def modules(browser):
    predictions, candidates, kept, oldest_s = browser.value(RATES)
    check((predictions, candidates) == (400, 25600), "400 predictions of 64 candidates a second are told as so many")
    check(300 <= kept <= 1200 and oldest_s > 29, "their times are thinned evenly")
    check(browser.value(BESIDE_A_HOLE) == 2, "level ground beside a hole looks like level ground")
    contours = browser.value(CONTOURS)
    check(contours == [[8, True], [4, True], 6, 0], f"contours run where the ground has their height, around holes, and not on level ground {contours}")
    loads = browser.value(LOADS)
    check(loads == [[1, None], [1, None], [3, "a"], [3, "a"], [5, "b"]], f"a map that did not come is asked for again, and one of another hash is another one {loads}")


def without_vehicles(browser, nesam, shots):
    with tempfile.TemporaryDirectory() as folder:
        pathlib.Path(folder, "steering.json").write_text(json.dumps(REPORT))
        server = Program(nesam, "serve", "--grpc", "127.0.0.1:0", "--http", "127.0.0.1:0", "--no-zenoh", "--reports", folder)
        try:
            browser.look(*SIZES["laptop"])
            browser.open(server.url)
            browser.wait("document.getElementById('link')?.dataset.state === 'live'")
            check("nesam demo" in text(browser, "#empty"), "an empty service says how to see one drive")
            browser.wait("document.querySelectorAll('#reports article').length === 1")
            report = text(browser, "#reports")
            check("steering_offset" in report and "0.200 m" in report and "gyro_bias" in report, "a diagnosis shows effect, rival, before and after")
            widths = browser.value("[...document.querySelectorAll('#reports i')].map((i) => i.getBoundingClientRect().width)")
            check(widths[0] > widths[1] > widths[2] > 0 and abs(widths[2] / widths[0] - 0.25) < 0.02, "its bars are as long as the errors")
            pathlib.Path(folder, "nothing.json").write_text(json.dumps(REPORT | {"verdict": "none", "reason": "nothing stands out", "effects": []}))
            browser.wait("document.querySelectorAll('#reports article').length === 2")
            check(text(browser, "#reports").count("with effect") == 1, "one that names no effect has no errors with it")
            browser.screenshot(shots / "empty.png")
            modules(browser)
        finally:
            server.stop()
        browser.wait("document.getElementById('link').dataset.state === 'lost'")
        check("No connection" in text(browser, "#empty"), "a service that stops is told, with what to do")
        browser.screenshot(shots / "lost.png")
        browser.errors = [error for error in browser.errors if "ERR_" not in error]


def interactions(browser):
    check(becomes(browser, "layer-elevation") and becomes(browser, "view-follow"), "it begins with the elevation and follows the vehicle")
    before = browser.value(PAINTED)
    browser.key("2")
    check(becomes(browser, "layer-semantics") and before > 50 and browser.value(PAINTED) > 50, "elevation and semantics are painted; key 2 changes them")
    browser.key("1")
    browser.click("#view-all")
    check(becomes(browser, "view-all"), "a button shows the whole map")
    box = browser.middle("#map")
    browser.drag(box, [box[0] + 60, box[1] + 30])
    check(becomes(browser, "view-all", False) and becomes(browser, "view-follow", False), "dragging frees the map")
    check("x " in text(browser, "#cursor") and " z " in text(browser, "#cursor"), "the place under the pointer is read")
    browser.key("f")
    check(becomes(browser, "view-follow"), "key F follows again")
    browser.key(" ")
    check(becomes(browser, "pause"), "space holds the picture still")
    age = text(browser, "#clock")
    time.sleep(1.5)
    check(text(browser, "#clock") == age, "and it stays still")
    browser.key(" ")
    browser.wait("document.getElementById('link').dataset.state === 'live'")
    browser.key("?")
    check(browser.value("document.getElementById('help').open"), "key ? explains keys and colours")
    browser.value("document.getElementById('help').close()")
    reached = browser.value("[...document.querySelectorAll('a[href], button, canvas[tabindex], summary')].filter((e) => e.tabIndex < 0).length")
    check(reached == 0, "everything that can be pressed is reached with the tab key")


def with_a_drive(browser, nesam, shots):
    # The recorded pace; a machine that does much else may be too slow for it.
    demo = Program(nesam, "demo", "--http", "127.0.0.1:0", "--hold", "--no-diagnosis")
    try:
        browser.look(*SIZES["laptop"])
        browser.open(demo.url)
        browser.wait("document.querySelectorAll('#soil tr').length === 6", 240)
        browser.wait("document.querySelectorAll('#nis-plot circle, #nis-plot .refused').length >= 3", 240)
        # One is enough: a machine that does much else predicts seldom.
        browser.wait("document.querySelectorAll('#latency-plot circle').length >= 1", 240)
        soil = text(browser, "#soil")
        check("kPa" in soil and ("not learned" in soil or "to" in soil), "soil parameters have units and bands or say that they are not learned")
        check("64 candidates" in text(browser, "#legend") and "90 %" in text(browser, "#legend"), "fan and 90 % regions are drawn")
        check(re.search(r"\d of \d+ in the 95 % band", text(browser, "#nis-text")), "consistency is told as a share")
        browser.wait("document.getElementById('forecast-text').textContent.includes('came true')", 240)
        check(re.search(r"[\d.]+ m off after 3.2 s, expected [\d.]+ m", text(browser, "#forecast-text")), "what predictions came to is told beside what was expected")
        check(re.search(r"median [\d.]+, 99 % [\d.]+", text(browser, "#latency-text")), "latency is told as quantiles")
        for plot, reading in (("nis", "NIS"), ("latency", "ms in the queue")):
            browser.hover(f"#{plot}-plot")
            browser.wait(f"document.querySelector('#{plot}-plot .note')?.textContent.includes('{reading}')")
        check(True, "what is under the pointer is read in both plots")
        check("%" in text(browser, "#service") and "m/s" in text(browser, "#vehicle"), "cache hits and the vehicle's motion have figures")
        check("at x" in browser.value("document.getElementById('map').getAttribute('aria-label')"), "the map says in words where the vehicle is")
        for name, (width, height) in SIZES.items():
            for dark in (False, True):
                browser.look(width, height, dark)
                time.sleep(1.0)
                look = f"{name}-{'dark' if dark else 'light'}"
                browser.screenshot(shots / f"{look}.png")
                overflow = browser.value("document.documentElement.scrollWidth - innerWidth")
                contrast = browser.value(CONTRAST)
                check(overflow <= 0 and min(contrast.values()) >= 4.5, f"{look}: nothing sticks out, text has contrast {min(contrast.values()):.1f}")
        browser.look(*SIZES["laptop"])
        interactions(browser)
        check(browser.value(NAMELESS) == 0, "everything has a name for a screen reader")
        check(browser.value(FOREIGN) == [], "nothing is loaded from elsewhere")
        with Proxy(demo.url) as url:
            browser.open(url)
            browser.wait(f"location.pathname === '/fleet/' && document.getElementById('link')?.dataset.state === 'live' && {PAINTED} > 50")
            check(True, "it comes alive below a path of a proxy, map and all")
    finally:
        demo.stop()


def main():
    if not find():
        print("skipped: no chromium")
        return
    nesam = sys.argv[1]
    with tempfile.TemporaryDirectory() as temporary, Browser() as browser:
        shots = pathlib.Path(sys.argv[3]) if sys.argv[2:3] == ["--shots"] else pathlib.Path(temporary)
        shots.mkdir(parents=True, exist_ok=True)
        without_vehicles(browser, nesam, shots)
        with_a_drive(browser, nesam, shots)
        errors = [error for error in browser.errors if "ERR_" not in error]
        check(not errors, f"no error in the console {errors}")
    print("live page: all as expected")


if __name__ == "__main__":
    main()
