"""The competitors: the same model in torch, set up as well as we can."""

import time
from typing import Callable, Dict, Tuple

import numpy as np
import torch

from network import TerrainNetwork
from rollout import Peer, Scene
from runtimes import fastest
from terrain import ExactTokens, GivenTokens, Ground, in_batches
from weights import Bundle

BATCHES = (16, 32, 64, 128, 256)
COMPILED_BATCH = 64


class Bf16Network(torch.nn.Module):
    """The terrain network with bf16 weights and activations in channels-last order."""

    def __init__(self, bundle: Bundle):
        super().__init__()
        self.network = TerrainNetwork(bundle).eval().to(torch.bfloat16).to(memory_format=torch.channels_last)

    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        """Patches (B, 4, 128, 128) f32 -> tokens (B, 134) bf16."""
        return self.network(patches.to(torch.bfloat16, memory_format=torch.channels_last))


def fastest_encoder(networks: Dict[str, Tuple[Callable, tuple]], ground: Ground, scene: Scene, say) -> Tuple[Callable, str]:
    """The fastest way to tokens among networks, each with the batches to try, and its name."""
    poses = torch.tensor(scene.start[[0, 1, 5]], dtype=torch.float32)[:, None] + torch.randn(3, 256)
    took = {}
    for name, (network, batches) in networks.items():
        for batch in batches:
            encode = in_batches(network, ground, batch)
            took[f"{name}, batch {batch}"] = (fastest(lambda: encode(*poses)) / poses.shape[1], encode)
            say(f"{name}, batch {batch}: {took[f'{name}, batch {batch}'][0] * 1e6:.0f} us per pose")
    name = min(took, key=lambda key: took[key][0])
    return took[name][1], name


def eager_encoder(bundle: Bundle, ground: Ground, scene: Scene, say):
    """Eager f32."""
    return fastest_encoder({"eager f32": (TerrainNetwork(bundle).eval(), BATCHES)}, ground, scene, say)


def tuned_encoder(bundle: Bundle, ground: Ground, scene: Scene, compiled: bool, say):
    """bf16 in channels-last order, eager or compiled, whichever is faster."""
    ways = {"bf16 channels-last": (Bf16Network(bundle), BATCHES)}
    if compiled:
        ways["bf16 channels-last, compiled"] = (torch.compile(Bf16Network(bundle)), (COMPILED_BATCH,))
    return fastest_encoder(ways, ground, scene, say)


def compile_steps(peer: Peer) -> Peer:
    """Compiles what happens in a step beside the terrain, for any number of samples: the Transformer, and drive line and physics."""
    peer.network = torch.compile(peer.trunk.forward, dynamic=True)
    peer.motion = torch.compile(peer.move, dynamic=True)
    return peer


def trunks(bundle: Bundle, ground: Ground, compiled: bool) -> Dict[str, Peer]:
    """Ways to do all but the terrain."""
    ways = {"eager f32": Peer(bundle, ground)}
    if compiled:
        ways["compiled f32"] = compile_steps(Peer(bundle, ground))
        ways["compiled, bf16 Transformer"] = compile_steps(Peer(bundle, ground, autocast=True))
    return ways


def fastest_trunk(ways: Dict[str, Peer], scene: Scene, controls: np.ndarray, given: GivenTokens, history: GivenTokens, say) -> str:
    """The fastest way to do a query whose tokens are given; compiles on the way."""
    took = {}
    for name, peer in ways.items():
        begin = time.perf_counter()
        peer.predict(scene, controls, given, history)
        first_s = time.perf_counter() - begin
        took[name] = fastest(lambda: peer.predict(scene, controls, given, history))
        say(f"{name}, tokens given: {took[name]:.3f} s, first run {first_s:.1f} s")
    return min(took, key=took.get)


def exact_query(peer: Peer, encode, scene: Scene, controls: np.ndarray, history: GivenTokens, steps: int) -> Callable[[], np.ndarray]:
    """The first steps of a query with both encoders at every pose."""
    return lambda: peer.predict(scene, controls, ExactTokens(encode), history, steps=steps)
