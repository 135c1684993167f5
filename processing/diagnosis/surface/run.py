"""Diagnose captures of an object against a reflectance model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from processing.computing.blas import one_blas_thread
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.surface.data import SurfaceData, read_surface
from processing.diagnosis.surface.diagnose import SurfaceJudged, diagnose_surface
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError


@one_blas_thread()
def diagnose_object(
    captures: Sequence[Path],
    model: InstrumentModel,
    material: Any,
    view: ViewingGeometry,
    say: Say = lambda line: None,
) -> tuple[SurfaceJudged, SurfaceProblem]:
    """Diagnose captures of one object jointly.

    Parameters
    ----------
    captures : of one instrument at one wavelength; several arm angles are best.
    model : instrument, as loaded from its file.
    material : reflectance model; view : geometry.

    Raises
    ------
    ProcessError : a capture cannot be used (arm angle, noise, object out of view), a material that cannot be bent.
    CaptureError : captures of several wavelengths.
    """
    data: list[SurfaceData] = []
    for path in captures:
        say(f"reading {path.name}")
        with Capture(path) as capture:
            data.append(read_surface(capture, model.at(capture.header.wavelength_nm), view, material))
    wavelengths = {c.wavelength_nm for c in data}
    if len(wavelengths) != 1:
        found = ", ".join(f"{w:g}" for w in sorted(wavelengths))
        raise CaptureError(f"the captures are at {found} nm; effects differ with wavelength. Give one wavelength.")
    problem = SurfaceProblem(model.at(wavelengths.pop()), data)
    return diagnose_surface(problem, material.name, say), problem
