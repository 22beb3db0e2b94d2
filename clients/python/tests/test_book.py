"""The Python of the book's tutorial runs against a real server, from the first line to the last."""

import pathlib
import re

import pytest

TUTORIAL = pathlib.Path(__file__).parents[3] / "docs" / "tutorial.md"


@pytest.mark.skipif(not TUTORIAL.is_file(), reason="the tutorial is in the repository")
def test_service_the_tutorial_runs(server_address, capsys):
    blocks = re.findall(r"<!-- python -->\n```python\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 4
    names = {}
    for block in blocks:
        exec(block.replace("127.0.0.1:50051", server_address), names)  # the reader's own session, line by line
    told = capsys.readouterr().out
    assert "APPLIED" in told
    ends = [float(y) for y in re.findall(r"y (-?[\d.]+) m", told)]
    assert len(ends) == 3 and ends[0] < ends[1] < ends[2], told
    assert re.search(r"standard deviation of x after 3.2 s: 0\.\d\d m", told), told
