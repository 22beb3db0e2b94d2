"""The learned half: terrain encoders, soil prior and token projection; causal Transformer with history and its two heads."""

import math
from typing import List, Tuple

import torch
from torch import nn
from torch.nn import functional as F

from weights import Bundle

HIDDEN, HEADS, BLOCKS = 128, 4, 2
HEAD_WIDTH = HIDDEN // HEADS
HISTORY = 32
SOIL_BOUNDS = ((3.0e4, 1.5e7), (10.0, 2.0e5), (0.1, 1.6), (50.0, 7.0e4), (0.09, 0.75), (0.002, 0.08))
SOIL_LOGARITHMIC = (True, True, False, True, False, True)


def conv(bundle: Bundle, name: str, channels: int) -> nn.Conv2d:
    """A 3x3 convolution of stride 2; the file has its weight as (filters, row x column x channel)."""
    weight, bias = bundle.pair(name)
    layer = nn.Conv2d(channels, weight.shape[0], 3, stride=2, padding=1)
    layer.weight = nn.Parameter(weight.reshape(-1, 3, 3, channels).permute(0, 3, 1, 2).contiguous())
    layer.bias = nn.Parameter(bias.clone())
    return layer


def linear(bundle: Bundle, name: str) -> nn.Linear:
    """A linear layer."""
    weight, bias = bundle.pair(name)
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight, layer.bias = nn.Parameter(weight.clone()), nn.Parameter(bias.clone())
    return layer


def norm(bundle: Bundle, name: str) -> nn.LayerNorm:
    """Layer normalisation."""
    layer = nn.LayerNorm(HIDDEN, eps=1e-5)
    weight, bias = bundle.pair(name)
    layer.weight, layer.bias = nn.Parameter(weight.clone()), nn.Parameter(bias.clone())
    return layer


class TerrainNetwork(nn.Module):
    """Patches (B, 4, 128, 128), elevation and colours in [-1, 1], to W_c c and the raw soil prior, (B, 128 + 6)."""

    def __init__(self, bundle: Bundle):
        super().__init__()
        encoder = lambda name, channels: nn.Sequential(
            conv(bundle, f"encoder.{name}.conv1", channels),
            nn.ReLU(),
            conv(bundle, f"encoder.{name}.conv2", 8),
            nn.ReLU(),
            conv(bundle, f"encoder.{name}.conv3", 16),
        )
        self.elevation, self.semantic = encoder("elevation", 1), encoder("semantic", 3)
        weight = bundle.arrays["token.context.weight"].reshape(HIDDEN, 2, 16 * 16 * 18)
        self.of_elevation, self.of_semantic = (nn.Parameter(weight[:, i].clone()) for i in range(2))
        self.soil = nn.Sequential(conv(bundle, "soil.conv1", 18), nn.SiLU(), conv(bundle, "soil.conv2", 32), nn.SiLU())
        self.soil_head = nn.Sequential(linear(bundle, "soil.hidden"), nn.SiLU(), linear(bundle, "soil.out"))

    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        high, coloured = self.elevation(patches[:, :1]), self.semantic(patches[:, 1:])
        flat = lambda z: z.permute(0, 2, 3, 1).reshape(z.shape[0], -1)
        token = F.linear(flat(high), self.of_elevation) + F.linear(flat(coloured), self.of_semantic)
        soil = self.soil_head(self.soil(coloured).mean((2, 3)))
        return torch.cat([token, soil], 1)


class Block(nn.Module):
    """One pre-norm block of the Transformer."""

    def __init__(self, bundle: Bundle, name: str):
        super().__init__()
        self.norm1, self.norm2 = norm(bundle, f"{name}.norm1"), norm(bundle, f"{name}.norm2")
        self.qkv, self.out = linear(bundle, f"{name}.qkv"), linear(bundle, f"{name}.out")
        self.up, self.down = linear(bundle, f"{name}.up"), linear(bundle, f"{name}.down")

    def project(self, x: torch.Tensor) -> Tuple[torch.Tensor, ...]:
        """Queries, keys and values (B, heads, T, 32) of tokens (B, T, 128)."""
        batch, tokens, _ = x.shape
        return self.qkv(self.norm1(x)).reshape(batch, tokens, 3, HEADS, HEAD_WIDTH).permute(2, 0, 3, 1, 4).unbind(0)

    def finish(self, x: torch.Tensor, attended: torch.Tensor) -> torch.Tensor:
        """What follows the attention, (B, T, 128)."""
        x = x + self.out(attended.transpose(1, 2).reshape(x.shape))
        return x + self.down(F.gelu(self.up(self.norm2(x)), approximate="tanh"))


class Trunk(nn.Module):
    """Token embedding, causal Transformer over 31 measured and up to 32 predicted tokens, heads."""

    def __init__(self, bundle: Bundle):
        super().__init__()
        self.embed = nn.Linear(14, HIDDEN)
        self.embed.weight = nn.Parameter(bundle.arrays["token.state.weight"].clone())
        self.embed.bias = nn.Parameter(bundle.arrays["token.bias"].clone())
        self.position = nn.Parameter(bundle.arrays["position"].clone())
        self.blocks = nn.ModuleList(Block(bundle, f"block{b}") for b in range(BLOCKS))
        self.norm = norm(bundle, "norm")
        self.sinkage, self.residual = linear(bundle, "sinkage"), linear(bundle, "residual")

    def prefix(self, entries: torch.Tensor, context: torch.Tensor) -> List[Tuple[torch.Tensor, torch.Tensor]]:
        """Keys and values (1, heads, T, 32) of each block for T measured tokens: scaled entries (T, 14) and W_c c (T, 128)."""
        tokens = len(entries)
        x = (self.embed(entries) + context + self.position[HISTORY - 1 - tokens : HISTORY - 1])[None]
        cache = []
        for block in self.blocks:
            q, k, v = block.project(x)
            cache.append((k, v))
            x = block.finish(x, F.scaled_dot_product_attention(q, k, v, is_causal=True))
        return cache

    def allocate(self, prefix, samples: int, horizon: int):
        """The history's keys and values, one copy for all samples, (heads, T, 32) each, and room for those of the rollout, (N, heads, K, 32) each."""
        cache = []
        for keys, values in prefix:
            # One place more than is filled: a full cache would be contiguous, and torch.compile would compile that case anew.
            room = [keys.new_empty(samples, HEADS, horizon + 1, HEAD_WIDTH) for _ in range(2)]
            cache.append((keys[0].transpose(1, 2).contiguous(), values[0], *room))
        return cache

    def forward(self, cache, k: int, entries: torch.Tensor, context: torch.Tensor) -> Tuple[torch.Tensor, torch.Tensor]:
        """Raw sinkage (N, 4) and residual (N, 12) of step `k` from scaled entries (N, 14) and W_c c (N, 128)."""
        x = (self.embed(entries) + context + self.position[HISTORY - 1 + k])[:, None]
        for block, (shared_keys, shared_values, keys, values) in zip(self.blocks, cache):
            q, key, value = block.project(x)
            keys[:, :, k : k + 1], values[:, :, k : k + 1] = key, value
            x = block.finish(x, attend(q, shared_keys, shared_values, keys[:, :, : k + 1], values[:, :, : k + 1]))
        x = self.norm(x)[:, 0]
        return self.sinkage(x), self.residual(x)


def attend(q, shared_keys, shared_values, keys, values):
    """Attention (N, heads, 1, 32) of one token of each sample: the history as one matrix product for all samples, then the sample's own tokens.

    Several times faster than torch's own attention, which would read a copy of the history for each sample.
    """
    q = q * HEAD_WIDTH**-0.5
    history = shared_keys.shape[2]
    over_shared = (q[:, :, 0].transpose(0, 1) @ shared_keys).transpose(0, 1)[:, :, None]
    weight = torch.cat([over_shared, q @ keys.transpose(2, 3)], -1).softmax(-1).to(values.dtype)
    from_shared = (weight[:, :, 0, :history].transpose(0, 1) @ shared_values).transpose(0, 1)[:, :, None]
    return from_shared + weight[..., history:] @ values


def soil_from_raw(raw: torch.Tensor, delta: torch.Tensor) -> torch.Tensor:
    """Soil (6, N), SI, of raw coordinates (N, 6) and a correction (6,) in logarithmic coordinates, clipped to the admissible bounds."""
    share, soil = torch.sigmoid(raw).T, []
    for i, ((low, high), logarithmic) in enumerate(zip(SOIL_BOUNDS, SOIL_LOGARITHMIC)):
        if logarithmic:
            value = torch.exp(math.log(low) + (math.log(high) - math.log(low)) * share[i] + delta[i])
        else:
            value = low + (high - low) * share[i] + delta[i]
        soil.append(value.clamp(low, high))
    return torch.stack(soil)
