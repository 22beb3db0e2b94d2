"""Client of the nesam kinodynamics prediction service.

`Client` opens sessions, uploads maps, sends measurements and asks for predictions, `AsyncClient` does the same in asyncio; arrays are numpy arrays. Units are
SI and radians, World is ENU (z up), Body is x forward, y left, z up. A state is the twelve numbers x y z roll pitch yaw vx vy vz wx wy wz, both velocities in
Body.
"""

from ._aio import AsyncClient, AsyncMeasurementStream
from ._aio_durable import AsyncDurableStream
from ._candidates import Drawing, PathCost, Ranking
from ._client import Client, MeasurementStream
from ._durable import DurableStream
from ._errors import (
    AlreadyExists,
    DeadlineExceeded,
    FailedPrecondition,
    InvalidArgument,
    NesamError,
    NotFound,
    Overloaded,
    Refused,
    Unavailable,
)
from ._extras import ExtraOutputs, Extras
from ._fallback import KinematicFallback
from ._messages import CHANNELS
from ._types import (
    Alarm,
    Answer,
    DiagnosisEvent,
    DiagnosisProgress,
    DiagnosisReport,
    DiagnosisStarted,
    Effect,
    FleetSoil,
    MapDescription,
    Measurement,
    Prediction,
    Provenance,
    Session,
    Soil,
    SoilCell,
    SoilEstimate,
    Tls,
    Validity,
    VehicleCard,
    WorldMap,
)

__all__ = [
    "CHANNELS",
    "Alarm",
    "AlreadyExists",
    "Answer",
    "AsyncClient",
    "AsyncDurableStream",
    "AsyncMeasurementStream",
    "Client",
    "DeadlineExceeded",
    "DiagnosisEvent",
    "DiagnosisProgress",
    "DiagnosisReport",
    "DiagnosisStarted",
    "Drawing",
    "DurableStream",
    "Effect",
    "ExtraOutputs",
    "Extras",
    "FailedPrecondition",
    "FleetSoil",
    "InvalidArgument",
    "KinematicFallback",
    "MapDescription",
    "Measurement",
    "MeasurementStream",
    "NesamError",
    "NotFound",
    "Overloaded",
    "PathCost",
    "Prediction",
    "Provenance",
    "Ranking",
    "Refused",
    "Session",
    "Soil",
    "SoilCell",
    "SoilEstimate",
    "Tls",
    "Unavailable",
    "Validity",
    "VehicleCard",
    "WorldMap",
]
