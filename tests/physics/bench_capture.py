"""Captures of a bench made by other physics than the model's, as a file and as `diagnose` reads it."""

from pathlib import Path

import numpy as np

from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.read_capture import read_capture
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Sample
from simulators.blind.undeclared_captures import TrueBench, TrueScene, digitize, expose, state_angles, write_capture


def bench_capture(
    folder: Path,
    file: Path,
    bench: TrueBench,
    air: bool = False,
    states: int = 40,
    seed: int = 7,
    *,
    scene=None,
    report_angles=None,
) -> Path:
    """A capture file of so many states of the instrument `file`: of air, which it states, or of an unknown sample.

    `scene` makes another scene of a random generator; `report_angles` changes the angles that the file states.
    """
    random = np.random.default_rng(seed)
    angles = state_angles(states, bench.mosaic, bench.zigzag)
    sample_scene = scene(random) if scene else TrueScene(random, np.eye(4) if air else None)
    counts = digitize(bench, expose(bench, sample_scene, angles), random)
    sample = Sample(kind="air" if air else "unknown")
    folder.mkdir(exist_ok=True)
    path = folder / "capture.h5"
    write_capture(
        path,
        bench,
        counts,
        report_angles(angles) if report_angles else angles,
        sample=sample,
        instrument=file.read_text(),
    )
    return path


def read(path: Path, file: Path) -> tuple[InstrumentModel, CaptureData]:
    """The instrument at 662 nm, and the capture as `diagnose` reads it."""
    model = InstrumentModel.load(file).at(662)
    with Capture(path) as capture:
        return model, read_capture(capture, model)
