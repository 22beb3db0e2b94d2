"""Goal: what the book tells people to type works. Method: its Python, and the shell blocks that need this client, run against a real server; every other block says
what runs it or why nothing can; every `nesam` command anywhere in the text is held against the options that the program has.

A block is marked by the remark above it: `run` (by crates/cli/tests/book.rs), `python`, `run beside a server` (both here), `run by FILE` or `not run: WHY`. A remark
`before` has Python that comes first, with `client`, `address`, `candidates` and `drive(client, session)`. Blocks of C++ are run by clients/cpp/tests/blocks.awk."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from conftest import start_server, straight
from test_client import fan

import nesam

ROOT = Path(__file__).parents[3]
BOOK = ROOT / "docs"
pytestmark = pytest.mark.skipif(not (BOOK / "SUMMARY.md").is_file(), reason="the book is in the repository")

_BLOCK = re.compile(r"(?:<!-- before\n(?P<before>.*?)\n-->\n)?(?:<!-- (?P<mark>.*?) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Block:
    page: str
    before: str
    mark: str
    language: str
    text: str

    @property
    def needs(self):
        """Packages without which Python is not run."""
        return re.findall(r"\w+", self.mark.partition("needs ")[2])


def pages():
    own = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")]
    return [*sorted(BOOK.glob("*.md")), *sorted(BOOK.glob("*/*.md")), *own, *sorted(ROOT.glob("clients/*/README.md")), *sorted(ROOT.glob("deploy/**/README.md"))]


def blocks():
    for page in pages():
        for found in _BLOCK.finditer(page.read_text(encoding="utf-8")):
            yield Block(page.relative_to(ROOT).as_posix(), found["before"] or "", found["mark"] or "", found["language"], found["text"])


def run_here(block):
    return block.mark.startswith("python") or block.mark == "run beside a server"


def test_property_every_block_is_run_or_says_why_not():
    assert all(re.fullmatch(r"|compiled only: .{10,}", block.mark) for block in blocks() if block.language == "cpp")
    found = [block for block in blocks() if block.language not in ("text", "toml", "cmake", "cpp")]
    for block in found:
        what = f"{block.page}:\n{block.text}"
        assert block.language in ("sh", "python"), f"a block of commands is `sh` or `python`: {what}"
        allowed = r"run|python(, needs [\w, ]+)?|run beside a server|run by (?P<file>\S+)|not run: .{10,}"
        mark = re.fullmatch(allowed, block.mark)
        assert mark, f"say above the block what runs it: {what}"
        assert block.mark != "run" or (block.language, block.page.split("/")[0]) == ("sh", "docs"), f"nobody runs it: {what}"
        named = re.findall(r"[\w./]+\.(?:rs|py|sh)|tests/fleet/run|docs/[\w/-]+\.md", block.mark)
        assert all((ROOT / name).is_file() for name in named), f"runs it, and is not there: {named}"
    assert sum(block.mark == "run" for block in found) >= 12 and sum(map(run_here, found)) >= 9


def told_commands():
    """Each `nesam` command of the text once, with its page: arguments up to what belongs to the shell."""
    told = {}
    for page in pages():
        text = page.read_text(encoding="utf-8")
        lines = [line for block in _BLOCK.finditer(text) for line in block["text"].replace("\\\n", " ").split("\n")]
        for line in lines + re.findall(r"`([^`\n]+)`", _BLOCK.sub("", text)):
            found = re.match(r"\s*(?:\w+=\S+ )*(?:cargo run --release -- |(?:\S*/)?nesam )(.*)", line)
            if found and not found[1].startswith("COMMAND"):
                words = shlex.split(found[1], comments=True)
                ends = next((i for i, word in enumerate(words) if re.match(r"[&|;<>]|2>", word)), len(words))
                told.setdefault(tuple(word for word in words[:ends] if word not in ("...", "…")), page.name)
    return told


def test_property_the_program_has_every_command_and_option_that_is_told(request):
    """With `--help` at its end a command says its help and does nothing, unless something before is none of its own."""
    server = request.config.getoption("--server")
    told = told_commands()
    for words, page in told.items():
        asked = subprocess.run([server, *words, "--help"], capture_output=True, text=True)
        unknown = re.search("unexpected argument|unrecognized subcommand", asked.stderr)
        assert not unknown, f"{page}: nesam {shlex.join(words)}\n{asked.stderr}"
    assert len(told) > 150


def test_service_the_reference_pages_are_what_the_program_says(request):
    """Services by the protocol's files, settings by the file of defaults, metrics by a server with everything switched on."""
    made = [sys.executable, ROOT / "tests/tools/reference.py", request.config.getoption("--server"), "--check"]
    done = subprocess.run(made, capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout}{done.stderr}run tests/tools/reference.py"


def drive(client, session):
    """A session that has driven for four seconds, opened where it is not there."""
    if session not in [one.session_id for one in client.sessions()]:
        client.open_session(session)
    client.measure(straight(session, 40))


@pytest.mark.parametrize("page", sorted({block.page for block in blocks() if run_here(block)}))
def test_service_what_a_page_tells_is_done(request, tmp_path, monkeypatch, page, capsys):
    """Blocks of a page in their order, in one folder beside one server and in one Python session, as a reader would."""
    options = ("--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh", "--store", "store", "--record", "recordings")
    process, address = start_server(request, *options, folder=tmp_path)
    monkeypatch.chdir(tmp_path)
    ran = 0
    with nesam.Client(address, timeout_s=60.0) as client:
        names = {"nesam": nesam, "np": np, "address": address, "client": client, "candidates": fan(8, 16), "drive": drive}
        for block in filter(run_here, (block for block in blocks() if block.page == page)):
            try:
                [__import__(package) for package in block.needs]
            except ImportError:
                continue
            exec(block.before, names)
            if block.language == "python":
                exec(block.text.replace("127.0.0.1:50051", address), names)  # the reader's own session, line by line
            else:
                beside(request, block.text, address)
            ran += 1
        if "rollout" in names:
            assert np.array(names["x"]).shape == (12, 20)
        if "planner" in names:
            assert tuple(names["command"].shape) == (2,)
    process.terminate()
    assert process.wait(timeout=30) == 0
    told = capsys.readouterr().out
    if page == "docs/tutorial.md":
        assert ran >= 4 and "APPLIED" in told
        ends = [float(y) for y in re.findall(r"y (-?[\d.]+) m", told)]
        assert len(ends) == 3 and ends[0] < ends[1] < ends[2], told
        assert re.search(r"standard deviation of x after 3.2 s: 0\.\d\d m", told), told
    if not ran:
        pytest.skip("what it needs is not installed")


def beside(request, text, address):
    """Runs shell text with the real binary and this Python; commands for a server are sent to that of the test."""
    binary = Path(request.config.getoption("--server")).resolve()
    ours = f'nesam() {{ if [ "$1" = effects ]; then command "{binary}" "$@" --server "http://{address}"; else command "{binary}" "$@"; fi; }}\n'
    environment = {**os.environ, "REPO": str(ROOT), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", ours + text], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{text}\n{done.stdout}{done.stderr}"
