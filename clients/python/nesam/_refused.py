"""What the service refuses of a question whatever the session, for those who answer in its place.

Limits that a server may be told otherwise are left out where more than the default may be allowed (samples), and are the defaults for a start.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from . import _types as t
from ._candidates import Drawing, PathCost
from ._fallback import invalid

if TYPE_CHECKING:
    from ._calls import Question

HORIZON_MAX = 32
"""Steps of the model."""

_PATH_POINTS_MAX = 1024
_WEIGHTS = ("path_weight", "speed_weight", "tilt_weight", "speed_change_weight", "second_change_weight", "temperature")
_STATE_FIELDS = [f"{part}.{axis}" for part in ("position_m", "attitude_rad", "velocity_m_s", "angular_velocity_rad_s") for axis in "xyz"]
# Roll and pitch up to half a turn; yaw may be unwrapped.
_STATE_MAX = (1e6,) * 3 + (math.pi + 1e-6,) * 2 + (1e4,) + (100.0,) * 3 + (50.0,) * 3


def check_question(question: "Question", controls: np.ndarray) -> None:
    """Raises InvalidArgument as the service does, but for the commands (`KinematicFallback.check`) and extras. controls: (samples, horizon, 2)."""
    drawing = question.controls if isinstance(question.controls, Drawing) else None
    samples, horizon = len(controls) if drawing is None else drawing.samples, controls.shape[1]
    if samples < 1:
        raise invalid("samples", f"is {samples}, at least 1 is needed")
    if not 1 <= horizon <= HORIZON_MAX:
        raise invalid("horizon", f"is {horizon}, allowed are 1 to {HORIZON_MAX}")
    if question.stride > horizon:
        raise invalid("output.stride", f"is {question.stride}, allowed are 0 to horizon = {horizon}")
    if question.samples_min > samples:
        raise invalid("samples_min", f"is {question.samples_min}, allowed are 0 to samples = {samples}")
    if drawing is not None:
        _check_drawing(drawing)
    if question.cost is not None:
        _check_cost(question.cost, samples)
        if question.extras is not None and question.extras.message().ByteSize() > 0:
            raise invalid("cost", "is given together with `extras`, allowed is one of the two")
    if question.start_stamp_ns is None and len(question.sent):
        raise invalid("start_stamp_ns", f"is missing, it is needed for the {len(question.sent)} commands of `sent`")
    if question.start is not None:
        if question.start_stamp_ns is not None:
            raise invalid("start", "is given together with `start_stamp_ns`, allowed is one of the two")
        _check_state(t.array(question.start, (12,), "start"))


def _check_drawing(drawing: Drawing) -> None:
    for field, sd in zip(("speed_sd_m_s", "second_sd"), drawing.sd):
        if not 0.0 <= sd <= 1e6:
            raise invalid(f"drawing.{field}", f"is {sd}, allowed are 0 to 1e6")
    if not 0.0 <= drawing.correlation < 1.0:
        raise invalid("drawing.correlation", f"is {drawing.correlation}, allowed is 0 to below 1")


def _check_cost(cost: PathCost, samples: int) -> None:
    path = np.asarray(cost.path, dtype=np.float32)
    if not 2 <= len(path) <= _PATH_POINTS_MAX:
        raise invalid("cost.path", f"has {path.size} numbers, allowed are 2 to {_PATH_POINTS_MAX} points of two")
    if not np.isfinite(path).all():
        raise invalid("cost.path", "holds a number that is not finite")
    if (path == path[0]).all():
        raise invalid("cost.path", f"holds {len(path)} times the same point, which has no direction")
    for field in _WEIGHTS:
        value = getattr(cost, field)
        if not 0.0 <= value <= 1e12:
            raise invalid(f"cost.{field}", f"is {value}, allowed are 0 to 1e12")
    if not math.isfinite(cost.speed_m_s):
        raise invalid("cost.speed_m_s", f"is {cost.speed_m_s}")
    if cost.best > samples:
        raise invalid("cost.best", f"is {cost.best}, there are {samples} candidates")


def _check_state(start: np.ndarray) -> None:
    for field, value, limit in zip(_STATE_FIELDS, start, _STATE_MAX):
        if not np.isfinite(value) or abs(value) > limit:
            raise invalid(f"start.{field}", f"is {value}, allowed is a finite number of magnitude up to {limit:g}")
