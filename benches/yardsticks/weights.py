"""Reads what `nesam` ships: a model bundle (weights, scales, vehicle card)."""

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Dict

import torch
from safetensors.torch import load_file


@dataclass(frozen=True)
class Bundle:
    """A trained model. `arrays`: weights by name, f32, shapes as in the file. `scales`: `normalization.toml`. `vehicle`: `vehicle.json`, SI and rad."""

    name: str
    arrays: Dict[str, torch.Tensor]
    scales: dict
    vehicle: dict

    def pair(self, name: str) -> tuple:
        """Weight and bias of a layer."""
        return self.arrays[f"{name}.weight"], self.arrays[f"{name}.bias"]


def read_bundle(folder: Path) -> Bundle:
    """Reads a bundle folder.

    Raises ValueError for a form that the peer does not have: it knows the whole model on the soil contact law, a car that steers its front wheels,
    speed-controlled rims and no effects, which is what the shipped car is.
    """
    manifest = tomllib.loads((folder / "manifest.toml").read_text())
    scales = tomllib.loads((folder / "normalization.toml").read_text())
    effects = tomllib.loads((folder / "effects.toml").read_text())
    vehicle = json.loads((folder / "vehicle.json").read_text())
    known = {
        "model": (manifest["model"], "nesam"),
        "effects": (effects["effects"], []),
        "contact_law": (vehicle.get("contact_law"), "soil_contact_model"),
        "second": (vehicle["second"], "steering_normalised"),
        "driveline.torque": (vehicle["driveline"].get("torque"), None),
    }
    for key, (found, expected) in known.items():
        if found != expected:
            raise ValueError(f"{folder}: {key} is {found!r}, this peer only knows {expected!r}")
    return Bundle(manifest["name"], load_file(folder / "weights.safetensors"), scales, vehicle)
