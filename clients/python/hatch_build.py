"""Build hook: generates the protobuf stubs before the package is put together."""

import importlib.util
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class StubsHook(BuildHookInterface):
    """Runs `nesam/build_protos.py` without importing the package, whose dependencies the build environment does not have."""

    def initialize(self, version, build_data):
        root = Path(self.root)
        spec = importlib.util.spec_from_file_location("build_protos", root / "nesam" / "build_protos.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.generate(root)
