"""The peers: their environment, made on first use, and their interpreter, one request at a time."""

import json
import os
import subprocess
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

HERE = Path(__file__).resolve().parent


class PeerProcess:
    """benchmarks/peers.py in the peers' environment."""

    def __init__(self, python: Path, folder: Path) -> None:
        self._folder = folder
        self._process = subprocess.Popen(
            [str(python), str(HERE / "peers.py")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.versions: dict[str, str] = self._ask({"task": "versions"})["versions"]

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        if self._process.stdin is None or self._process.stdout is None:
            raise RuntimeError("the peers' process has no pipes")
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the peers' process ended")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def task(self, name: str, *arrays: np.ndarray, scale: float = 1.0) -> Callable[[], float]:
        """A function that runs the task once and returns its seconds times `scale`, or raises RuntimeError."""
        files = []
        for k, array in enumerate(arrays):
            file = self._folder / f"{name}_{k}.npy"
            np.save(file, array)
            files.append(str(file))

        def run() -> float:
            reply = self._ask({"task": name, "data": files})
            if "error" in reply:
                raise RuntimeError(reply["error"])
            return scale * float(reply["seconds"])

        return run

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()


def peer_python(interpreter: Path | None, console: Console) -> Path | None:
    """The peers' interpreter; makes their environment where none is given."""
    if interpreter is not None:
        return interpreter
    folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "umov/peers"
    python = folder / "bin/python"
    requirements, stamp = HERE / "requirements.txt", folder / "complete"
    if not stamp.exists() or stamp.read_text() != requirements.read_text():
        console.print(f"making an environment for the peers in {folder} (once, about a minute)")
        venv.create(folder, with_pip=True, clear=True)
        pip = [str(python), "-m", "pip", "install", "-q", "-r", str(requirements)]
        done = subprocess.run(pip, check=False, capture_output=True, text=True)
        if done.returncode:
            console.print(done.stderr[-2000:])
            console.print("the peers could not be installed: comparing with numpy and OpenCV alone", style="yellow")
            return None
        stamp.write_text(requirements.read_text())
    return python
