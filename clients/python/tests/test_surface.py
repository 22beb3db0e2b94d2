"""Goal: what threads can do asyncio can too, by the same names. Method: the public surfaces, held against each other and against the protocol."""

import inspect

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
    at_once = {"measurement_stream", "durable_stream", "alarms", "watch_soil", "diagnose"}
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
