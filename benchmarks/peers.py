"""The peers' side of benchmarks/run.py: runs in an environment with benchmarks/requirements.txt.

Reads one JSON line a task, {"task": name, "data": [files]}, runs it once, answers {"seconds": s} or {"error": text}.
"""

import contextlib
import io
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")

import numpy as np


def versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    by_package = {}
    for name in ("numpy", "py_pol", "katsu", "muellerkit", "polanalyser", "pymueller", "opencv-python"):
        with contextlib.suppress(PackageNotFoundError):
            by_package[name] = version(name)
    return by_package


def polanalyser_mueller(frames: Any, generator: Any, analyzer: Any) -> Callable[[], object]:
    import polanalyser

    return lambda: polanalyser.calcMueller(frames, generator, analyzer)


def polanalyser_mosaic(frame: Any) -> Callable[[], object]:
    import polanalyser

    def run() -> None:
        channels = polanalyser.demosaicing(frame, polanalyser.COLOR_PolarMono)
        stokes = polanalyser.calcLinearStokes(channels, np.deg2rad([0, 45, 90, 135]))
        polanalyser.cvtStokesToDoLP(stokes)
        polanalyser.cvtStokesToAoLP(stokes)

    return run


def muellerkit_lu_chipman(m: Any) -> Callable[[], object]:
    import muellerkit

    return lambda: muellerkit.decompose_depolarizer_retarder_diattenuator(m)


def katsu_lu_chipman(m: Any) -> Callable[[], object]:
    from katsu import mueller

    return lambda: mueller.decompose_depolarizer(m, return_all=True)


def pymueller_lu_chipman(m: Any) -> Callable[[], object]:
    import pymueller

    return lambda: pymueller.decomposition.lu_chipman(1, len(m), m.reshape(1, len(m), 16).copy())


def _py_pol_sample(m: Any) -> Any:
    from py_pol.mueller import Mueller

    sample = Mueller("sample")
    sample.from_matrix(np.moveaxis(m, 0, -1).copy())
    return sample


def py_pol_lu_chipman(m: Any) -> Callable[[], object]:
    return lambda: _py_pol_sample(m).analysis.decompose_polar(decomposition="PRD")


def py_pol_eigenvalues(m: Any) -> Callable[[], object]:
    return lambda: np.linalg.eigh(np.moveaxis(_py_pol_sample(m).covariance_matrix().M, -1, 0))


TASKS = {f.__name__: f for f in (
    polanalyser_mueller, polanalyser_mosaic, muellerkit_lu_chipman, katsu_lu_chipman, pymueller_lu_chipman,
    py_pol_lu_chipman, py_pol_eigenvalues,
)}  # fmt: skip


def answer(request: dict[str, Any]) -> dict[str, Any]:
    if request["task"] == "versions":
        return {"versions": versions()}
    try:
        run = TASKS[request["task"]](*(np.load(f) for f in request["data"]))
        with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
            begin = time.perf_counter()
            run()
            return {"seconds": time.perf_counter() - begin}
    except (ImportError, MemoryError, TypeError, ValueError, AttributeError) as error:
        return {"error": f"{type(error).__name__}: {error}"}


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("ignore")
    for line in sys.stdin:
        sys.stdout.write(json.dumps(answer(json.loads(line))) + "\n")
        sys.stdout.flush()
