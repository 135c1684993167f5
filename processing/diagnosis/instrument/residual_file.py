"""Residuals of a diagnosis as a file: what a page or a script draws maps, states and harmonics from."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.diagnosis.instrument.diagnose import Judged
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.errors import ProcessError
from processing.storage.integrity.h5_door import DAMAGE
from processing.whole_file import whole_file

MOMENTS = ("before", "after")


@dataclass(frozen=True)
class StoredResidual:
    """Residual of one capture, before and after the correction.

    Attributes
    ----------
    name : of the capture.
    images : for "before" and "after" (L, rows, columns), in units of the noise of one intensity; NaN where not used.
    per_state : for each (L,) rms over the pixels.
    harmonics : for each, axis to amplitudes of the state means.
    """

    name: str
    images: dict[str, NDArray[np.float16]]
    per_state: dict[str, NDArray[np.float64]]
    harmonics: dict[str, dict[str, list[float]]]


def write_residuals(path: Path, judged: Judged, problem: InstrumentProblem) -> None:
    """Write the residuals of every capture to a new .npz file. Raises ProcessError if it exists."""
    arrays: dict[str, Any] = {}
    entries = []
    for k, data in enumerate(problem.captures):
        harmonics = {}
        for moment, residual in zip(MOMENTS, (judged.before[k], judged.after[k]), strict=True):
            # Units of the noise: three digits are more than anybody sees.
            half = np.finfo(np.float16)
            arrays[f"image_{moment}_{k}"] = np.clip(residual.image, half.min, half.max).astype(np.float16)
            arrays[f"per_state_{moment}_{k}"] = residual.per_state
            harmonics[moment] = {axis: values.tolist() for axis, values in residual.harmonics.items()}
        entries.append({"name": data.name, "harmonics": harmonics})
    try:
        with whole_file(path, new=True) as new, new.open("wb") as file:
            np.savez_compressed(file, told=np.array(json.dumps(entries)), **arrays)
    except FileExistsError as error:
        raise ProcessError(f"{path} exists and is not replaced. Give another --residuals.") from error


def read_residuals(path: Path) -> list[StoredResidual]:
    """Residuals of every capture from such a file. Raises ProcessError."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            entries = json.loads(str(stored["told"]))
            return [
                StoredResidual(
                    name=str(entry["name"]),
                    images={m: stored[f"image_{m}_{k}"] for m in MOMENTS},
                    per_state={m: stored[f"per_state_{m}_{k}"] for m in MOMENTS},
                    harmonics=entry["harmonics"],
                )
                for k, entry in enumerate(entries)
            ]
    except DAMAGE as error:
        raise ProcessError(f"{path} is no file of residuals of a diagnosis ({error})") from error
