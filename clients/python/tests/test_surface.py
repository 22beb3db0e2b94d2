"""Goal: what threads can do asyncio can too, by the same names. Method: the public surfaces, held against each other and against the protocol."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import nesam
from nesam._connection import reading_methods

PAIRS = [
    pytest.param(nesam.Client, nesam.AsyncClient, id="client"),
    pytest.param(nesam.MeasurementStream, nesam.AsyncMeasurementStream, id="measurement stream"),
    pytest.param(nesam.DurableStream, nesam.AsyncDurableStream, id="durable stream"),
]


def surface(cls):
    """What `cls` offers: by name the arguments with their defaults, None for an attribute; `__enter__` and `__aenter__` are one name."""
    offered = {}
    for name, member in inspect.getmembers(cls):
        if name == "__init__" or not name.startswith("_"):
            arguments = inspect.signature(member).parameters.values() if callable(member) else None
            offered[name] = arguments and [(one.name, one.default, one.kind) for one in arguments]
    return {**offered, "with": any(hasattr(cls, enter) for enter in ("__enter__", "__aenter__"))}


@pytest.mark.parametrize("threads, tasks", PAIRS)
def test_property_asyncio_offers_what_threads_have(threads, tasks):
    assert surface(threads) == surface(tasks)


@pytest.mark.parametrize("threads, tasks", PAIRS)
def test_property_what_waits_is_awaited(threads, tasks):
    at_once = {"measurement_stream", "durable_stream", "exchange", "alarms", "watch_soil", "diagnose"}
    for name in surface(threads):
        member = getattr(tasks, name, None)
        if callable(member) and not name.startswith("_") and name != "with":
            assert inspect.iscoroutinefunction(member) == (name not in at_once), name
        if callable(member) and name != "with":
            assert name == "__init__" or inspect.getdoc(member), f"{name} has no docstring"


def test_property_what_is_tried_again_is_what_the_protocol_says_changes_nothing():
    """`PredictStream` and measurements are streams; watches are begun anew by whoever watches."""
    found = {f"{one['service']}/{one['method']}" for one in reading_methods()}
    sessions = {"nesam.v1.Sessions/Get", "nesam.v1.Sessions/List", "nesam.v1.Sessions/Export"}
    maps = {"nesam.v1.Terrain/Get", "nesam.v1.Terrain/List", "nesam.v1.Soil/Map"}
    assert found == {*sessions, *maps, "nesam.v1.Prediction/Predict"}


def test_property_every_public_name_is_explained():
    for name in nesam.__all__:
        told = getattr(nesam, name)
        if inspect.isclass(told):
            assert (told.__doc__ or "").strip() and not told.__doc__.startswith(f"{name}("), name
            for method, member in inspect.getmembers(told, inspect.isfunction):
                assert method.startswith("_") or inspect.getdoc(member), f"{name}.{method}"


STRICT = """
import asyncio
from typing import Optional

import nesam
import numpy as np


def plan(client: nesam.Client) -> Optional[float]:
    state = np.zeros(12)
    client.measure([nesam.Measurement("truck", 0, state, (1.0, 0.0), wheel_speed_rad_s=np.ones(4))])
    for answer in client.exchange(iter([nesam.Measurement("truck", 0, state, (1.0, 0.0))])):
        assert answer.outcome
    controls = np.full((64, 32, 2), [2.0, 0.1], np.float32)
    try:
        prediction = client.predict("truck", controls, start=state, cost=nesam.PathCost(np.zeros((2, 2)), speed_m_s=3.0, best=4))
    except nesam.Overloaded as error:
        return error.retry_after_s
    for event in client.diagnose("truck"):
        if isinstance(event, nesam.DiagnosisReport):
            client.apply_effects("truck", event.effects)
    return float(prediction.states[0, -1, 0]) if not prediction.validity[0] & nesam.Validity.OFF_MAP else None


async def watch(client: nesam.AsyncClient) -> list[nesam.Alarm]:
    measurement = nesam.Measurement("truck", 0, [0.0] * 12, np.zeros(2))
    async with client.durable_stream("truck") as stream:
        try:
            answer: Optional[nesam.Answer] = await stream.send(measurement)
        except nesam.Refused as error:
            answer, first = error.answer, error.refused[0][0].stamp_ns
            assert first
        assert answer and answer.outcome
    answers = client.exchange([measurement])
    outcomes = [one.outcome async for one in answers]
    await answers.aclose()
    assert outcomes
    return [alarm async for alarm in client.alarms("truck")]


async def ask(client: nesam.AsyncClient) -> nesam.Prediction:
    return (await asyncio.gather(client.predict("truck", np.zeros((1, 1, 2)))))[0]
"""


def test_property_types_hold_strictly(tmp_path):
    """Of the package itself, and of a program that uses it."""
    pytest.importorskip("mypy")
    pytest.importorskip("numpy", minversion="1.26")
    (tmp_path / "program.py").write_text(STRICT)
    mypy = [sys.executable, "-m", "mypy", "--cache-dir", tmp_path / "cache"]
    settings = Path(__file__).parents[1] / "pyproject.toml"
    for checked in ([*mypy, "--config-file", settings, "-p", "nesam"], [*mypy, "--strict", tmp_path / "program.py"]):
        done = subprocess.run(checked, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
