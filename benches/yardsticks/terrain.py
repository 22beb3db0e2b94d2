"""The ground: heights under points, patches around poses, and where terrain tokens come from."""

import math
from typing import Callable

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from drives import World

PATCH_PX, PATCH_RESOLUTION_M = 128, 0.1
FOOTPRINT_M = 0.3
GRID_M, HEADINGS = 0.25, 72
TOKEN = 134


def footprint_slopes(elevation_m: np.ndarray, resolution_m: float) -> np.ndarray:
    """Slopes (2, height, width) along x and y: central differences over a wheel's footprint, averaged over three lines across it."""
    height, width = elevation_m.shape
    reach = max(1, round(FOOTPRINT_M / 2.0 / resolution_m))
    rows, columns = np.arange(height), np.arange(width)
    south, north = np.maximum(rows - reach, 0), np.minimum(rows + reach, height - 1)
    west, east = np.maximum(columns - reach, 0), np.minimum(columns + reach, width - 1)
    x = sum(elevation_m[r][:, east] - elevation_m[r][:, west] for r in (south, rows, north))
    y = sum(elevation_m[north][:, c] - elevation_m[south][:, c] for c in (west, columns, east))
    return np.stack([x / (resolution_m * 3.0 * (east - west)), y / (resolution_m * 3.0 * (north - south))[:, None]]).astype(np.float32)


class Ground(nn.Module):
    """A map as tensors, looked up at many points at once. Points off the map take the border."""

    def __init__(self, world: World, scales: dict, dtype: torch.dtype):
        super().__init__()
        self.origin_m, self.resolution_m = world.origin_m, world.resolution_m
        self.height, self.width = world.elevation_m.shape
        if np.isnan(world.elevation_m).any():
            raise ValueError(f"world {world.name} has holes, this peer knows none")
        surface = np.concatenate([world.elevation_m[None], footprint_slopes(world.elevation_m, world.resolution_m)])
        self.register_buffer("surface", torch.tensor(surface, dtype=dtype).reshape(3, -1).T.contiguous())
        mean, half = (np.array(scales[key])[:, None, None] for key in ("semantic_mean", "semantic_half_range"))
        colours = (world.rgb.transpose(2, 0, 1) - mean) / half
        self.half_range_m = scales["elevation_half_range_m"]
        image = np.concatenate([world.elevation_m[None] / self.half_range_m, colours])
        self.register_buffer("image", torch.tensor(image, dtype=dtype)[None])
        pixel = (PATCH_PX - 1) / 2.0 - torch.arange(PATCH_PX, dtype=dtype)
        self.register_buffer("pixel", pixel * (PATCH_RESOLUTION_M / world.resolution_m))

    def cells(self, x, y):
        """Grid coordinates (column, row) of World points."""
        return (x - self.origin_m[0]) / self.resolution_m, (y - self.origin_m[1]) / self.resolution_m

    def forward(self, x: torch.Tensor, y: torch.Tensor):
        """Height (m) and slopes along x and y of the ground under points of any shape, bilinear."""
        u, v = self.cells(x, y)
        u, v = u.clamp(0, self.width - 1), v.clamp(0, self.height - 1)
        west, south = u.floor().clamp(max=self.width - 2), v.floor().clamp(max=self.height - 2)
        east, north = (u - west)[..., None], (v - south)[..., None]
        at = south.to(torch.int64) * self.width + west.to(torch.int64)
        sw, se, nw, ne = (self.surface[at + step] for step in (0, 1, self.width, self.width + 1))
        low, high = sw + east * (se - sw), nw + east * (ne - nw)
        return (low + north * (high - low)).unbind(-1)

    def patches(self, x: torch.Tensor, y: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
        """Patches (B, 4, 128, 128) around poses (B,): row 0 furthest ahead, column 0 furthest left, elevation relative to the centre, all in [-1, 1]."""
        u, v = self.cells(x, y)
        sin, cos = torch.sin(yaw)[:, None, None], torch.cos(yaw)[:, None, None]
        ahead, left = self.pixel[None, :, None], self.pixel[None, None, :]
        columns = u[:, None, None] + cos * ahead - sin * left
        rows = v[:, None, None] + sin * ahead + cos * left
        at = torch.stack([columns * (2.0 / (self.width - 1)) - 1.0, rows * (2.0 / (self.height - 1)) - 1.0], dim=-1)
        image = self.image.expand(len(x), -1, -1, -1)
        patches = F.grid_sample(image, at, mode="bilinear", padding_mode="border", align_corners=True)
        centre = self(x, y)[0][:, None, None] / self.half_range_m
        return torch.cat([(patches[:, :1] - centre[:, None]).clamp(-1.0, 1.0), patches[:, 1:]], dim=1)


Encode = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


def in_batches(network: Callable[[torch.Tensor], torch.Tensor], ground: Ground, batch: int) -> Encode:
    """Tokens (B, 134) at poses (B,) each: crops, then the network, so many poses at a time that what is between them stays near the processor."""

    @torch.inference_mode()
    def encode(x, y, yaw):
        starts = range(0, len(x), batch)
        return torch.cat([network(ground.patches(x[i : i + batch], y[i : i + batch], yaw[i : i + batch])).to(x.dtype) for i in starts])

    return encode


class ExactTokens:
    """Both encoders at every pose: what the paper's text amounts to."""

    def __init__(self, encode: Encode):
        self.encode = encode

    def at(self, k: int, x: torch.Tensor, y: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
        """Tokens (B, 134) at the poses of step `k`."""
        return self.encode(x, y, yaw)


class GivenTokens:
    """Tokens that somebody has computed before: (K, N, 134)."""

    def __init__(self, tokens: torch.Tensor):
        self.tokens = tokens

    def at(self, k, x, y, yaw):
        """Tokens (N, 134) of step `k`, whatever the poses."""
        return self.tokens[k]


class GridTokens:
    """The terrain cache of `nesam`: exact tokens at the nodes of a pose grid (0.25 m, 5 degrees), trilinear between them, nodes encoded when first asked for."""

    def __init__(self, encode: Encode, ground: Ground):
        self.encode = encode
        self.low = [math.floor(o / GRID_M) - 1 for o in ground.origin_m]
        cells = [math.ceil(side * ground.resolution_m / GRID_M) + 3 for side in (ground.width, ground.height)]
        self.cells = cells
        self.row_of = torch.full((cells[0] * cells[1] * HEADINGS,), -1, dtype=torch.int64)
        self.values = ground.surface.new_empty(0, TOKEN)
        bits = torch.arange(8)[:, None]
        self.bits = [(bits >> i) & 1 for i in range(3)]

    def at(self, k, x, y, yaw):
        """Tokens (B, 134) at poses (B,)."""
        place = [x / GRID_M, y / GRID_M, torch.remainder(yaw, 2.0 * math.pi) * (HEADINGS / (2.0 * math.pi))]
        base = [p.floor() for p in place]
        share = [p - b for p, b in zip(place, base)]
        weight = torch.ones_like(x)[None]
        node = []
        for bit, s, b, i in zip(self.bits, share, base, range(3)):
            weight = weight * torch.where(bit == 1, s, 1.0 - s)
            node.append(b.to(torch.int64) + bit)
        column = (node[0] - self.low[0]).clamp(0, self.cells[0] - 1)
        row = (node[1] - self.low[1]).clamp(0, self.cells[1] - 1)
        flat = (column * self.cells[1] + row) * HEADINGS + node[2] % HEADINGS
        rows = self.row_of[flat]
        if bool((rows < 0).any()):
            self.fill(flat[rows < 0].unique())
            rows = self.row_of[flat]
        token = weight[0][:, None] * self.values[rows[0]]
        for corner in range(1, 8):
            token = torch.addcmul(token, weight[corner][:, None], self.values[rows[corner]])
        return token

    def fill(self, nodes: torch.Tensor):
        """Encodes nodes and keeps them."""
        heading, cell = nodes % HEADINGS, nodes // HEADINGS
        dtype = self.values.dtype
        x = (cell // self.cells[1] + self.low[0]).to(dtype) * GRID_M
        y = (cell % self.cells[1] + self.low[1]).to(dtype) * GRID_M
        yaw = heading.to(dtype) * (2.0 * math.pi / HEADINGS)
        self.row_of[nodes] = torch.arange(len(nodes)) + len(self.values)
        self.values = torch.cat([self.values, self.encode(x, y, yaw)])
