"""The terrain network (encoders, soil prior, projection) in ONNX Runtime and OpenVINO, from the same weights."""

import tempfile
import time
import warnings
from pathlib import Path
from typing import Callable, Dict

import numpy as np
import onnxruntime
import torch

from network import TerrainNetwork

try:
    import openvino
except ImportError:
    # Not for every Python; the rest is timed without it.
    openvino = None

BATCHES = (16, 32, 64, 128)


def export(network: TerrainNetwork, path: Path) -> None:
    """Writes the network as ONNX: patches (B, 4, 128, 128) -> tokens (B, 134)."""
    axes = {"patches": {0: "batch"}, "tokens": {0: "batch"}}
    names = {"input_names": ["patches"], "output_names": ["tokens"], "dynamic_axes": axes}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, (torch.zeros(2, 4, 128, 128),), str(path), dynamo=False, **names)


def onnx_runtime(path: Path, threads: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """Runs patches (P, 4, 128, 128) in batches of a size; f32."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return lambda patches, batch: np.concatenate([session.run(None, {"patches": part})[0] for part in split(patches, batch)])


def open_vino(path: Path, threads: int, precision: str, hint: str) -> Callable[[np.ndarray, int], np.ndarray]:
    """The same in OpenVINO. precision: f32 or bf16. hint: LATENCY (one request on all threads) or THROUGHPUT (a request for each thread)."""
    core = openvino.Core()
    settings = {"INFERENCE_PRECISION_HINT": precision, "PERFORMANCE_HINT": hint, "INFERENCE_NUM_THREADS": threads}
    compiled = core.compile_model(core.read_model(str(path)), "CPU", settings)
    queue = openvino.AsyncInferQueue(compiled)

    def run(patches: np.ndarray, batch: int) -> np.ndarray:
        parts = split(patches, batch)
        tokens = [None] * len(parts)
        queue.set_callback(lambda request, i: tokens.__setitem__(i, request.get_output_tensor(0).data.copy()))
        for i, part in enumerate(parts):
            queue.start_async({"patches": part}, i)
        queue.wait_all()
        return np.concatenate(tokens)

    return run


def split(patches: np.ndarray, batch: int) -> list:
    """Batches of a size."""
    return [patches[i : i + batch] for i in range(0, len(patches), batch)]


def prepare(network: TerrainNetwork, patches: np.ndarray, threads: int) -> Dict[str, dict]:
    """The runtimes by name: a function that runs all patches with the batch (and hint) that is fastest here, and its largest deviation from torch f32."""
    with torch.inference_mode():
        expected = network(torch.from_numpy(patches)).numpy()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "terrain.onnx"
        export(network, path)
        ways = {"ONNX Runtime f32": {"": onnx_runtime(path, threads)}}
        for precision in ("f32", "bf16") if openvino else ():
            ways[f"OpenVINO {precision}"] = {hint: open_vino(path, threads, precision, hint) for hint in ("LATENCY", "THROUGHPUT")}
    prepared = {}
    for name, hints in ways.items():
        seconds = {(hint, batch): fastest(lambda: run(patches, batch)) for hint, run in hints.items() for batch in BATCHES}
        hint, batch = min(seconds, key=seconds.get)
        run = hints[hint]
        error = float(np.abs(run(patches, batch) - expected).max() / np.abs(expected).max())
        setting = ", ".join(filter(None, [hint.lower(), f"batch {batch}"]))
        prepared[name] = {"run": lambda run=run, batch=batch: run(patches, batch), "setting": setting, "relative_error": error}
    return prepared


def fastest(work: Callable[[], object], times: int = 3) -> float:
    """Shortest of several runs after a first one, s."""
    work()
    seconds = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)
