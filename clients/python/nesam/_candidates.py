"""Candidates that the service draws, and what candidates are worth."""

from dataclasses import dataclass
from typing import Optional, Tuple

import numpy as np

from ._given import unmasked, whole
from .v1 import prediction_pb2


@dataclass(frozen=True, eq=False)
class Drawing:
    """Candidates as MPPI draws them: the first is the nominal sequence, the others are nominal plus Gaussian noise, cut to the range of the vehicle card
    and to nothing narrower: not to what was trained, nor to limits of a planner or of how fast commands may change.

    nominal: (horizon, 2), speed m/s and second command in the unit of the vehicle card. samples: N. sd: standard deviations of the two, in their units.
    correlation: of the noise from one step to the next, 0 (white) to below 1. seed: the same drawing gives the same candidates from the same version of the
    service. 8 K bytes travel instead of 8 N K.
    """

    nominal: np.ndarray
    samples: int
    sd: Tuple[float, float]
    correlation: float = 0.0
    seed: int = 0

    def message(self) -> prediction_pb2.CandidateDrawing:
        """As message. ValueError for an array of a wrong shape or with masked numbers, and a seed that is none of 64 bits."""
        if np.shape(self.sd) != (2,):
            raise ValueError(f"sd must be two numbers, for speed and second command, not {self.sd!r}")
        speed_sd, second_sd = self.sd
        return prediction_pb2.CandidateDrawing(
            nominal=_pairs(self.nominal, "nominal"),
            speed_sd_m_s=speed_sd,
            second_sd=second_sd,
            correlation=self.correlation,
            seed=whole(self.seed, "seed", bits=64),
        )


@dataclass(frozen=True, eq=False)
class PathCost:
    """What candidates are worth along a path: the mean over the steps of weighted squares; only the best are sent.

    path: (points, 2), World, m, in the order they are driven. speed_m_s: to be made along it. path_weight: of the distance, per m^2. speed_weight: of the
    velocity along the path (vx and vy turned by the yaw alone) against `speed_m_s`, per (m/s)^2. tilt_weight: of roll and pitch, per rad^2.
    speed_change_weight, second_change_weight: of the changes of the commands from step to step, per unit squared. best: candidates to send, 0 = none.
    temperature: of the mean command, in units of the cost; 0 = no mean. A candidate that overturns, leaves the map or has a state that is not finite costs
    infinitely much; other flags of `Prediction.validity`, such as SPEED_UNTRAINED, cost nothing. Not together with extras.
    """

    path: np.ndarray
    speed_m_s: float
    path_weight: float = 1.0
    speed_weight: float = 1.0
    tilt_weight: float = 0.0
    speed_change_weight: float = 0.0
    second_change_weight: float = 0.0
    best: int = 1
    temperature: float = 0.0

    def message(self) -> prediction_pb2.PathCost:
        """As message. ValueError for an array of a wrong shape or with masked numbers, and a negative `best`."""
        return prediction_pb2.PathCost(
            path=_pairs(self.path, "path"),
            speed_m_s=self.speed_m_s,
            path_weight=self.path_weight,
            speed_weight=self.speed_weight,
            tilt_weight=self.tilt_weight,
            speed_change_weight=self.speed_change_weight,
            second_change_weight=self.second_change_weight,
            best=whole(self.best, "best"),
            temperature=self.temperature,
        )


@dataclass(frozen=True, eq=False)
class Ranking:
    """What became of all candidates.

    costs: (samples,) float32, infinite for the worthless. best: (rows,) indices of the candidates that the rows of the prediction are, best first.
    mean_controls: (horizon, 2) float32, all candidates weighted with exp(-(cost - least) / temperature); None without a temperature or a finite cost.
    """

    costs: np.ndarray
    best: np.ndarray
    mean_controls: Optional[np.ndarray]


def _pairs(values: np.ndarray, name: str) -> bytes:
    values = np.ascontiguousarray(unmasked(values, name), dtype="<f4")
    if values.ndim != 2 or values.shape[1] != 2 or len(values) == 0:
        raise ValueError(f"{name} has shape {values.shape}, expected (any, 2)")
    return values.tobytes()


def ranking(reply: prediction_pb2.PredictReply) -> Optional[Ranking]:
    """What a reply says of all candidates; None when it was not asked for."""
    if not reply.costs:
        return None
    return Ranking(
        costs=np.frombuffer(reply.costs, dtype="<f4"),
        best=np.array(reply.best, dtype=np.int64),
        mean_controls=np.frombuffer(reply.mean_controls, dtype="<f4").reshape(-1, 2) if reply.mean_controls else None,
    )
