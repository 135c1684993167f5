"""Diagnose capture files against an instrument model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from processing.computing.blas import one_blas_thread
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.read_capture import read_capture
from processing.diagnosis.captured.screening import screened
from processing.diagnosis.instrument.diagnose import Judged, diagnose
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.posterior import Say
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError


@one_blas_thread()
def diagnose_captures(
    captures: Sequence[Path | str], model: InstrumentModel, say: Say = lambda line: None
) -> tuple[Judged, InstrumentProblem]:
    """Diagnose capture files jointly.

    Parameters
    ----------
    captures
        Of one instrument, at one wavelength or several; what is known of each sample is in the file.
    model
        As loaded from its file.

    Returns
    -------
    Verdict, names and correction; and the problem that they are the answer to.

    Raises
    ------
    CaptureError
        A file cannot be used, or none is given.
    """
    if not captures:
        raise CaptureError("no capture to diagnose: one file or several of one instrument are wanted")
    models: list[InstrumentModel] = []
    data: list[CaptureData] = []
    for path in map(Path, captures):
        say(f"reading {path.name}")
        with Capture(path) as capture:
            models.append(model.nominal_at(capture.header.wavelength_nm))
            data.append(screened(read_capture(capture, models[-1]), models[-1], say))
    judged = diagnose(InstrumentProblem(models, data), say, model)
    return judged, judged.problem
