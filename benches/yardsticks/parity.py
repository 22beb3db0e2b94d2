"""Holds the peer's prediction against that of the running server: if both are the same model, they say the same."""

from dataclasses import dataclass

import nesam
import numpy as np
import torch

from drives import World
from network import TerrainNetwork
from rollout import Peer, Scene
from service import SESSION
from terrain import ExactTokens, Ground, GridTokens, in_batches
from weights import Bundle


@dataclass(frozen=True)
class Deviation:
    """Largest deviation over all samples and steps: horizontal position m, height m, roll and pitch rad, yaw rad, and speed m/s."""

    position_m: float
    z_m: float
    tilt_rad: float
    yaw_rad: float
    speed_m_s: float

    def __str__(self) -> str:
        angles = f"roll/pitch {self.tilt_rad:.1e} rad, yaw {self.yaw_rad:.1e} rad"
        return f"position {self.position_m:.1e} m, z {self.z_m:.1e} m, {angles}, velocity {self.speed_m_s:.1e} m/s"


def deviation(ours: np.ndarray, theirs: np.ndarray) -> Deviation:
    """Largest deviation between predicted states (N, K, 12)."""
    d = np.abs(theirs.astype(np.float64) - ours.astype(np.float64))
    yaw = np.minimum(d[..., 5], 2.0 * np.pi - d[..., 5])
    position = np.hypot(d[..., 0], d[..., 1])
    return Deviation(*(float(x.max()) for x in (position, d[..., 2], d[..., 3:5], yaw, d[..., 6:9])))


def compare(client: nesam.Client, bundle: Bundle, world: World, scene: Scene, controls: np.ndarray, dtype: torch.dtype):
    """Deviation from the server's reply of the peer on the server's pose grid, and with both encoders at every pose."""
    ours = client.predict(SESSION, controls).states
    ground = Ground(world, bundle.scales, dtype)
    encode = in_batches(TerrainNetwork(bundle).to(dtype).eval(), ground, 64)
    peer = Peer(bundle, ground, dtype)
    return tuple(deviation(ours, peer.predict(scene, controls, tokens)) for tokens in (GridTokens(encode, ground), ExactTokens(encode)))
