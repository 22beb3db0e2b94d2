"""Generates the protobuf stubs `nesam/v1` from `proto/nesam/v1`: `python -m nesam.build_protos` (needs grpcio-tools)."""

from pathlib import Path


def proto_root(root: Path) -> Path:
    """Folder with `nesam/v1/*.proto`: beside the package in a source distribution, at the top of the repository in a checkout."""
    for candidate in (root / "proto", root.parent.parent / "proto"):
        if (candidate / "nesam" / "v1" / "types.proto").is_file():
            return candidate
    raise FileNotFoundError(f"no proto/nesam/v1 in or above {root}")


def generate(root: Path) -> Path:
    """Writes `nesam/v1/*_pb2.py`, `*_pb2.pyi` and `*_pb2_grpc.py` below `root`; returns that folder."""
    from grpc_tools import protoc

    source = proto_root(root)
    out = root / "nesam" / "v1"
    out.mkdir(parents=True, exist_ok=True)
    (out / "__init__.py").write_text('"""Generated from proto/nesam/v1; do not edit."""\n')
    files = sorted(str(path) for path in (source / "nesam" / "v1").glob("*.proto"))
    arguments = ["protoc", f"-I{source}", f"--python_out={root}", f"--pyi_out={root}", f"--grpc_python_out={root}", *files]
    if protoc.main(arguments) != 0:
        raise RuntimeError("the .proto files do not compile")
    return out


if __name__ == "__main__":
    print(generate(Path(__file__).resolve().parent.parent))
