"""Make a capture out of data measured elsewhere: a table of states, and frames or channel fluxes."""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from math import prod
from pathlib import Path

import h5py
import numpy as np

from processing.doors import one_line, require_place, require_room
from processing.instrument.measured_matrix import NUMBER
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.captures.frame_layout import Beams
from processing.storage.captures.nexus import attach
from processing.storage.captures.schema import CaptureHeader, create_layout, write_closing
from processing.storage.formats.doubtful_units import require_nm, require_unit
from processing.storage.formats.foreign_arrays import ImportFailed, frame_files
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.import_source import (
    FrameSource,
    dimensions_of,
    named_files,
    places_of,
    require_one_source,
    require_order,
    source_of,
    states_of_stack,
    with_darks,
)
from processing.storage.formats.state_csv import StatesFile, read_states
from processing.storage.integrity.checksums import row_crc32, write_checksums

#: Called with (states done, states in all).
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ImportPlan:
    """States and frames as they were read, before anything is written."""

    states: StatesFile
    source: FrameSource
    model: InstrumentModel | None


def understand(request: ImportRequest) -> ImportPlan:
    """Read the states, and find their frames.

    Raises
    ------
    ProcessError : the states file, a frame or the stack cannot be used, or a number is probably in another unit.
    ConfigError, WavelengthError : the instrument file cannot be used.
    """
    require_nm(request.wavelength_nm)
    model = None
    if request.instrument is not None:
        model = InstrumentModel.load(request.instrument)
        model.at(request.wavelength_nm)
    frames = frame_files(request.stack) if request.stack is not None else None
    places = places_of(request.stack, frames)
    names = tuple(c.name for c in model.channels) if model and model.mosaic is None else ("camera",)
    if model is not None and model.beams and (places or (request.stack and dimensions_of(request.stack) == 3)):
        # Beams on one sensor: their images are cut apart when the capture is read.
        names = ("beams",)
    count = None
    if model is not None and set(model.axes) <= {NUMBER} and request.stack is not None and request.states is None:
        # Nothing turns: each frame is a state, and no table has to say more of it.
        count = len(places) if places else states_of_stack(request.stack, len(names))
    states = read_states(
        request.states,
        model.axes if model else (),
        request.columns,
        request.angles == "radians",
        arrays=frames.numbers if frames else None,
        count=count,
        source=request.stack or "frames",
    )
    if model is not None and NUMBER in model.axes:
        states = replace(states, angles_deg={**states.angles_deg, NUMBER: np.arange(len(states), dtype=float)})
    require_unit(states, request.columns, request.angles)
    states = states.repeated(request.repeats)
    require_one_source(request, states, has_folder=bool(places or frames))
    if states.files is not None:
        folder = states.path.parent
        if frames is None:
            places = tuple((folder / name, None) for name in states.files)
        else:
            places = named_files(request, states, frames)
    elif frames is not None:
        require_order(request, states, frames)
    source = source_of(request, states, places, names, has_model=model is not None)
    if request.darks is not None:
        states, source = with_darks(request.darks, states, source)
    return ImportPlan(states, source, model)


def is_imported(request: ImportRequest) -> bool:
    """Whether the capture has this sample and title, and is newer than all of its data. Raises as `understand`."""
    if not request.out.is_file():
        return False
    with Capture(request.out) as capture:
        header = capture.header
    if header.sample != request.sample or request.title not in ("", header.title):
        return False
    written_ns = request.out.stat().st_mtime_ns
    return all(file.stat().st_mtime_ns < written_ns for file in _files_of(request, understand(request)))


def _files_of(request: ImportRequest, understood: ImportPlan) -> list[Path]:
    """Files that a capture is made of."""
    texts = (request.stack, request.darks, request.states, request.instrument, *request.columns.values())
    files = [*understood.source.files]
    for text in map(str, filter(None, texts)):
        frames = frame_files(text) if text == request.darks else None
        files += frames.files if frames else [Path(re.split(r"::|\[\d+\]$", text)[0])]
    return [file for file in files if file.is_file()]


def import_capture(request: ImportRequest, progress: Progress | None = None) -> CaptureHeader:
    """Write a capture file from states and their frames; returns the header that was written.

    Raises ProcessError, ConfigError, WavelengthError: as `understand`, or the capture exists already.
    """
    require_place(request.out, request.overwrite, captures_too=True)
    understood = understand(request)
    if request.out.exists() and any(request.out.samefile(file) for file in _files_of(request, understood)):
        raise ImportFailed(f"{request.out}: has the data themselves, and is not replaced. Give another --out.")
    states, source, model = understood.states, understood.source, understood.model
    detector = request.detector
    if detector.bits is None and source.dtype.kind == "u":
        detector = detector.model_copy(update={"bits": 8 * source.dtype.itemsize})
    beams = model.beams if model and source.channels == ("beams",) else None
    if beams:
        try:
            Beams(beams).shape(source.shape[1:])
        except ValueError as error:
            raise ImportFailed(f"{states.path}: {error}") from error
    header = CaptureHeader(
        title=request.title or one_line(f"imported from {states.path.resolve().parent.name}/{states.path.name}"),
        simulated=False,
        mode="import",
        wavelength_nm=request.wavelength_nm,
        omega_deg=request.omega_deg,
        sample=request.sample,
        detector=detector,
        channels=source.channels,
        mosaic=model.mosaic if model else None,
        beams=beams,
        instrument_yaml=request.instrument.read_text(encoding="utf-8") if request.instrument else "",
        versions={"umov": version("umov"), "numpy": np.__version__, "h5py": h5py.__version__},
    )
    partial = request.out.with_name(request.out.name + ".partial")
    require_room(partial, len(states) * prod(source.shape) * source.dtype.itemsize, ImportFailed)
    try:
        with h5py.File(partial, "w") as h5:
            _write(h5, header, states, source, progress=progress)
        os.replace(partial, request.out)
    finally:
        partial.unlink(missing_ok=True)
    return header


def _write(
    h5: h5py.File, header: CaptureHeader, states: StatesFile, source: FrameSource, *, progress: Progress | None
) -> None:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    create_layout(
        h5, header, states.angles_deg, states.role, frame_shape=source.shape[1:], dtype=source.dtype, start_time=now
    )
    data = h5["entry/instrument/detector/data"]
    row_sums = np.zeros(data.shape[:3], np.uint32)
    count = 0
    for count, frame in enumerate(source.frames(), 1):
        if frame.dtype.kind == "f" and not np.isfinite(frame).any():
            raise ImportFailed(f"{states.path}:{states.line[count - 1]}: the frame of this state has no finite value")
        data[count - 1] = frame
        row_sums[count - 1] = row_crc32(frame.astype(data.dtype, copy=False))
        if progress:
            progress(count, len(states))
    for axis, angle in states.angles_deg.items():
        h5[f"entry/instrument/{axis}/value"][...] = angle
    table = h5["entry/states"]
    table["frame_id"][...] = np.arange(count)
    if states.exposure_s is not None:
        table["exposure_s"][...] = states.exposure_s
    if states.time_s is not None:
        table["host_time_s"][...] = states.time_s
    if states.sigma is not None:
        table["sigma"] = states.sigma
        table["sigma"].attrs["units"] = "count"
        attach(table["sigma"], h5["entry"], ["state"])
    table["done"][...] = 1
    write_checksums(h5["entry"], row_sums)
    write_closing(h5, "complete", {"imported": now})
