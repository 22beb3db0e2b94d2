"""A server for tools and tests that need one for a moment."""

import contextlib
import re
import subprocess
import threading


@contextlib.contextmanager
def served(command, of="grpc", cwd=None):
    """Runs `nesam serve` as this command says; gives the address of its gRPC, or of what else it tells, when it is ready, and ends it."""
    process = subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        address = None
        for line in process.stdout:
            if match := re.match(rf"{of}\s+(\S+)", line):
                address = match.group(1)
            if line.startswith("ready"):
                break
        if address is None:
            raise RuntimeError(f"{command} ended without serving")
        # It may say more, and would wait for a reader.
        threading.Thread(target=process.stdout.read, daemon=True).start()
        yield address
    finally:
        process.terminate()
        process.wait(30)
