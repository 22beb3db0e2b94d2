"""Side by side timing: ours, a peer, ours, the next peer, and so on in rounds, so that what else the machine does meets all alike."""

import statistics
import time
from dataclasses import dataclass, field
from typing import Callable, List

import nesam
import numpy as np

from service import SESSION, processor_s


@dataclass
class Ours:
    """The server's queries of one size. `controls`: sets (N, K, 2), each query takes the next. Seconds of wall at the client and of the server's processors."""

    client: nesam.Client
    pid: int
    controls: List[np.ndarray]
    queries: int
    asked: int = 0
    wall_s: List[float] = field(default_factory=list)
    processor_s: List[float] = field(default_factory=list)

    def warm(self) -> None:
        """Asks every set once, so that all terrain that they meet is encoded."""
        for controls in self.controls:
            self.client.predict(SESSION, controls)

    def visit(self) -> List[float]:
        """Times a few queries, none with the commands of the one before."""
        took, before = [], processor_s(self.pid)
        for _ in range(self.queries):
            controls = self.controls[self.asked % len(self.controls)]
            self.asked += 1
            begin = time.perf_counter()
            self.client.predict(SESSION, controls)
            took.append(time.perf_counter() - begin)
        self.processor_s.append((processor_s(self.pid) - before) / self.queries)
        self.wall_s += took
        return took


@dataclass
class Entry:
    """A peer. `work` does `1 / scale` of a query of the size of `ours`; `kind` is the target that it counts for: eager, tuned or cached; others count for none."""

    name: str
    kind: str
    setting: str
    work: Callable[[], object]
    scale: float
    ours: Ours
    wall_s: List[float] = field(default_factory=list)
    processor_s: List[float] = field(default_factory=list)
    ratio: List[float] = field(default_factory=list)

    def visit(self, before: List[float]) -> List[float]:
        """Times the peer between the queries `before` and others after it, which it returns."""
        began, began_cpu = time.perf_counter(), time.process_time()
        self.work()
        wall = (time.perf_counter() - began) * self.scale
        self.processor_s.append((time.process_time() - began_cpu) * self.scale)
        self.wall_s.append(wall)
        after = self.ours.visit()
        self.ratio.append(wall / statistics.median(before + after))
        return after


def contest(entries: List[Entry], rounds: int, say: Callable[[str], None]) -> None:
    """Runs the rounds; every entry's own first run is not timed."""
    for entry in entries:
        begin = time.perf_counter()
        entry.work()
        say(f"{entry.name}: first run {time.perf_counter() - begin:.1f} s")
    for turn in range(rounds):
        before = {}
        for entry in entries:
            size = id(entry.ours)
            before[size] = entry.visit(before.get(size) or entry.ours.visit())
            say(f"round {turn + 1}: {entry.name} {entry.wall_s[-1]:.3f} s, {entry.ratio[-1]:.1f} times ours")
