"""What users give, as messages take it. What they cannot take is a ValueError that names it, and says what is allowed."""

import operator
import re
from typing import Any

import numpy as np


def unmasked(values: Any, name: str) -> Any:
    """`values` as they are; refused where numpy's mask hides some, which lies over numbers that mean nothing."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name} has masked numbers, expected none: fill them (numpy.ma.filled) or leave them out")
    return values


def elevations(values: Any) -> np.ndarray:
    """Elevations of cells, m, as float32 in one piece; what numpy's mask hides is a hole (NaN)."""
    if np.ma.isMaskedArray(values):
        values = np.ma.filled(values.astype("<f4"), np.nan)
    return np.ascontiguousarray(values, dtype="<f4")


def whole(value: Any, name: str, bits: int = 32, signed: bool = False) -> int:
    """An integer of so many bits."""
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or not low <= number <= high:
        raise ValueError(f"{name} is {value!r}, allowed are whole numbers from {low} to {high}")
    return number


def stamp(value: Any, name: str = "stamp_ns") -> int:
    """An instant of the vehicle's clock, ns."""
    return whole(value, name, bits=64, signed=True)


def vehicle_or_none(name: str) -> str:
    """The name of a vehicle for the header of every call; "" = none. gRPC refuses other characters in words that say nothing of it."""
    if name and not re.fullmatch("[A-Za-z0-9_.-]{1,64}", name):
        raise ValueError(f"vehicle_id is {name!r}, expected 1 to 64 of A-Z a-z 0-9 _ . -")
    return name
