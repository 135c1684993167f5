"""Make a capture out of data measured elsewhere: a table of states, and frames or channel fluxes."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import chain, islice
from math import prod
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import thread_count
from processing.doors import one_line, read_text, require_picture, require_place, require_room
from processing.instrument.measured import NUMBER
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.captures.frame_layout import Beams
from processing.storage.captures.nexus import attach
from processing.storage.captures.schema import CaptureHeader, Detector, Sample, create_layout, write_closing
from processing.storage.formats.doubtful_units import require_nm, require_unit
from processing.storage.formats.foreign_arrays import FrameFiles, ImportFailed, frame_files, missing_numbers
from processing.storage.formats.frame_files import PAGED, check_stack, open_stack, read_frame
from processing.storage.formats.state_csv import StatesFile, read_states
from processing.storage.integrity.checksums import row_crc32, write_checksums
from processing.storage.integrity.h5_door import read_npy

#: Called with (states done, states in all).
Progress = Callable[[int, int], None]

Frame = NDArray[Any]

#: What stands for each of several measurements in the options of an import.
ITEM = "{item}"

#: Most bytes of a file of 16 numbers.
MOST_SAMPLE_BYTES = 1 << 16


@dataclass(frozen=True)
class FrameSource:
    """Frames of all states, whatever they come from: shape (channels, rows, columns), type, and an iterator.

    `names` has the file of each frame, where there are files, and `files` where they are.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    frames: Callable[[], Iterator[Frame]]
    channels: tuple[str, ...]
    names: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()


#: A file, and a page of it where it has several.
Place = tuple[Path, int | None]


@dataclass(frozen=True)
class ImportRequest:
    """What `process import` was asked for; see its help."""

    states: Path | None
    out: Path
    wavelength_nm: float
    stack: str | None = None
    instrument: Path | None = None
    sample: Sample = field(default_factory=Sample)
    detector: Detector = field(default_factory=Detector)
    omega_deg: float | None = None
    title: str = ""
    overwrite: bool = False
    columns: dict[str, str] = field(default_factory=dict)
    angles: Literal["degrees", "radians"] | None = None
    darks: str | None = None
    repeats: int = 1


@dataclass(frozen=True)
class Understood:
    """States and frames as they were read, before anything is written."""

    states: StatesFile
    source: FrameSource
    model: InstrumentModel | None


def understand(request: ImportRequest) -> Understood:
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
    found = frame_files(request.stack) if request.stack is not None else None
    places = _places(request.stack, found)
    names = tuple(c.name for c in model.channels) if model and model.mosaic is None else ("camera",)
    if model is not None and model.beams and (places or (request.stack and _dimensions(request.stack) == 3)):
        # Beams on one sensor: their images are cut apart when the capture is read.
        names = ("beams",)
    count = None
    if model is not None and set(model.axes) <= {NUMBER} and request.stack is not None and request.states is None:
        # Nothing turns: each frame is a state, and no table has to say more of it.
        count = len(places) if places else _count(request.stack, len(names))
    states = read_states(
        request.states,
        model.axes if model else (),
        request.columns,
        request.angles == "radians",
        arrays=found.numbers if found else None,
        count=count,
        source=request.stack or "frames",
    )
    if model is not None and NUMBER in model.axes:
        states = replace(states, angles_deg={**states.angles_deg, NUMBER: np.arange(len(states), dtype=float)})
    require_unit(states, request.columns, request.angles)
    states = states.repeated(request.repeats)
    _require_one_source(request, states, has_folder=bool(places or found))
    if states.files is not None:
        folder = states.path.parent
        if found is None:
            places = tuple((folder / name, None) for name in states.files)
        else:
            places = _named_files(request, states, found)
    elif found is not None:
        _require_order(request, states, found)
    source = _source(request, states, places, names, has_model=model is not None)
    if request.darks is not None:
        states, source = _with_darks(request.darks, states, source)
    return Understood(states, source, model)


def for_item(request: ImportRequest, item: str) -> ImportRequest:
    """The request for one of several measurements: `item` replaces `{item}`, and a stack without `{item}`."""

    def of_item(text: str) -> str:
        return text.replace(ITEM, item)

    columns = {name: of_item(column) for name, column in request.columns.items()}
    has_own_table = columns != request.columns or ITEM in str(request.states)
    stack = request.stack or ("" if has_own_table else ITEM)
    return replace(
        request,
        states=request.states and Path(of_item(str(request.states))),
        stack=(of_item(stack) if ITEM in stack else item) if stack else None,
        darks=request.darks and of_item(request.darks),
        columns=columns,
    )


def name_of_item(item: str) -> Path:
    """The usual capture of one of several measurements: NAME.h5 next to it, NAME_DATASET.h5 for `NAME.h5::/dataset`."""
    file, _, inside = item.partition("::")
    path = Path(file) if Path(file).name.strip(".") else Path(file).resolve()
    stem = path.name if path.is_dir() else path.stem
    return path.parent / ("_".join([stem, *re.findall(r"\w+", inside)]) + ".h5")


def is_imported(request: ImportRequest) -> bool:
    """Whether the capture has this sample and title, and is newer than all of its data. Raises as `understand`."""
    if not request.out.is_file():
        return False
    with Capture(request.out) as capture:
        header = capture.header
    if header.sample != request.sample or request.title not in ("", header.title):
        return False
    made = request.out.stat().st_mtime_ns
    return all(file.stat().st_mtime_ns < made for file in _files_of(request, understand(request)))


def _files_of(request: ImportRequest, understood: Understood) -> list[Path]:
    """Files that a capture is made of."""
    texts = (request.stack, request.darks, request.states, request.instrument, *request.columns.values())
    files = [*understood.source.files]
    for text in map(str, filter(None, texts)):
        found = frame_files(text) if text == request.darks else None
        files += found.files if found else [Path(re.split(r"::|\[\d+\]$", text)[0])]
    return [file for file in files if file.is_file()]


def _places(stack: str | None, found: FrameFiles | None) -> tuple[Place, ...]:
    """Frames of a folder, a picture, or the pages of a picture; empty for other stacks."""
    if stack is None or found is not None:
        return tuple((file, None) for file in found.files) if found else ()
    file = Path(stack)
    if file.suffix.lower() not in (*PAGED, ".png"):
        return ()
    pages = require_picture(file, ImportFailed)
    return tuple((file, page) for page in range(pages)) if pages > 1 else ((file, None),)


def _dimensions(stack: str) -> int:
    return len(open_stack(stack, None).shape)


def _count(stack: str, channels: int) -> int:
    """States of a stack in which nothing turns."""
    shape = open_stack(stack, None).shape
    return int(shape[0]) if len(shape) == 4 or (len(shape) == 3 and channels == 1) else 1


def _require_one_source(request: ImportRequest, states: StatesFile, *, has_folder: bool) -> None:
    given = {
        "the column `file`": states.files is not None,
        "--stack": request.stack is not None and (states.files is None or not has_folder),
        "columns `channel_<name>`": bool(states.channels),
    }
    ways = [name for name, present in given.items() if present]
    if len(ways) != 1:
        found = " and ".join(ways) or "none of them"
        raise ImportFailed(f"{states.path}: frames come from exactly one of {', '.join(given)}; found {found}.")


def _plain(name: str) -> str:
    """The name of a file without its folder, as the table of another system may write it."""
    return name.replace("\\", "/").rpartition("/")[2]


def _named_files(request: ImportRequest, states: StatesFile, found: FrameFiles) -> tuple[Place, ...]:
    """The files of a folder that a column of the table names, with their ending or without."""
    of_name = {file.stem: file for file in found.files} | {file.name: file for file in found.files}
    absent = [(line, n) for line, n in zip(states.line, states.files or (), strict=True) if _plain(n) not in of_name]
    if absent:
        line, name = absent[0]
        raise ImportFailed(f"{states.path}:{line}: column file: {request.stack} has no frame {one_line(name)}")
    return tuple((of_name[_plain(name)], None) for name in states.files or ())


def _require_order(request: ImportRequest, states: StatesFile, found: FrameFiles) -> None:
    """Raise ImportFailed where there is not a frame for each state, or a column names the files in another order."""
    names = {file.name for file in found.files} | {file.stem for file in found.files}
    for column, cells in states.ignored.items():
        plain = [_plain(cell) for cell in cells]
        if set(plain) <= names and len(set(plain)) == len(plain):
            in_order = [n in (f.name, f.stem) for n, f in zip(plain, found.files, strict=False)]
            if not all(in_order) or len(in_order) != len(found.files):
                raise ImportFailed(
                    f"{states.path}: column {column!r} names the frames of {request.stack} in an order of its own, or "
                    f"not all of them. Add --columns 'file={column}'"
                )
    if len(found.files) != len(states):
        gap = missing_numbers(found.files)
        numbers = f"; their names leave out {one_line(gap, 60)}" if gap else ""
        often, more = divmod(len(found.files), len(states))
        raise ImportFailed(
            f"{request.stack}: {len(found.files)} frames for {len(states)} states of {states.path}{numbers}. "
            + (f"If each state has {often} frames, one after the other, add --repeats {often}. " if not more else "")
            + "Choose frames by a pattern, as --stack 'FOLDER/img_*.tif', or by a column of the table: --columns "
            "file=COLUMN"
        )


def import_capture(request: ImportRequest, progress: Progress | None = None) -> CaptureHeader:
    """Write a capture file from states and their frames; returns the header that was written.

    Raises
    ------
    ProcessError, ConfigError, WavelengthError : as `understand`, or the capture exists already.
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


def _source(
    request: ImportRequest, states: StatesFile, places: tuple[Place, ...], names: tuple[str, ...], *, has_model: bool
) -> FrameSource:
    if states.channels:
        return _fluxes(states, names if has_model else tuple(states.channels))
    if places:
        return _images(states, places, names)
    assert request.stack is not None
    return _stack(request.stack, states, names)


def _fluxes(states: StatesFile, names: tuple[str, ...]) -> FrameSource:
    if sorted(names) != sorted(states.channels):
        raise ImportFailed(
            f"{states.path}:1: the instrument's channels are {', '.join(names)}; "
            f"the file has columns for: {', '.join(states.channels)}."
        )
    fluxes = np.stack([states.channels[n] for n in names], axis=1)[..., None, None]
    return FrameSource((len(names), 1, 1), fluxes.dtype, lambda: iter(fluxes), names)


def _stack(text: str, states: StatesFile, names: tuple[str, ...]) -> FrameSource:
    stack = open_stack(text, len(states))
    if len(stack.shape) == 1:
        # A flux a state.
        stack = stack[...][:, None, None]
    if len(states) == 1 and len(stack.shape) in (2, 3) and len(stack.shape) - 2 == (len(names) > 1):
        stack = stack[...][None]
    check_stack(text, stack, len(states), len(names))
    per_state = (len(names), *stack.shape[-2:])
    return FrameSource(per_state, stack.dtype, lambda: (np.asarray(s).reshape(per_state) for s in stack), names)


def _images(states: StatesFile, places: tuple[Place, ...], names: tuple[str, ...]) -> FrameSource:
    if len(names) != 1:
        raise ImportFailed(
            f"{states.path}: one image a state is one channel, but the instrument has {', '.join(names)}; "
            "give a --stack (states, channels, rows, columns) or channel columns."
        )
    if len(places) != len(states):
        raise ImportFailed(f"{places[0][0]}: {len(places)} pages for {len(states)} states of {states.path}")
    absent = [(line, file) for line, (file, _) in zip(states.line, places, strict=True) if not os.path.isfile(file)]
    if absent:
        line, file = absent[0]
        more = f" (and {len(absent) - 1} more)" if len(absent) > 1 else ""
        raise ImportFailed(
            f"{states.path}:{line}: column file: no such frame: {one_line(file)}{more}. If the frames are in another "
            "folder, add --stack FOLDER"
        )
    first = read_frame(*places[0])

    def load(item: tuple[int, Place]) -> Frame:
        line, (file, page) = item
        image = read_frame(file, page)
        if image.shape != first.shape or image.dtype != first.dtype:
            raise ImportFailed(
                f"{states.path}:{line}: {file.name} is {_kind(image)}, but the first frame is {_kind(first)}; "
                "all must be alike."
            )
        return image[None]

    def frames() -> Iterator[Frame]:
        # Decoding releases the interpreter lock; a few frames ahead keep the writer fed at constant memory.
        items = iter(list(zip(states.line, places, strict=True)))
        with ThreadPoolExecutor(thread_count()) as pool:
            waiting = [pool.submit(load, item) for item in islice(items, 4 * thread_count())]
            while waiting:
                frame = waiting.pop(0).result()
                waiting += [pool.submit(load, item) for item in islice(items, 1)]
                yield frame

    shown = tuple(file.name if page is None else f"{file.name}[{page}]" for file, page in places)
    return FrameSource((1, *first.shape), first.dtype, frames, names, shown, tuple(file for file, _ in places))


def _with_darks(text: str, states: StatesFile, source: FrameSource) -> tuple[StatesFile, FrameSource]:
    """The states, and after them the dark frames of another file or folder."""
    exposures = states.exposure_s
    if exposures is not None and np.ptp(exposures) > 0:
        raise ImportFailed(f"--darks {text}: the states have several exposures; give darks their own rows in the CSV")
    places = _places(text, frame_files(text))
    if places:
        darks = [read_frame(*place)[None] for place in places]
    else:
        stack = open_stack(text, None, source.shape[1:])
        stack = stack[...][None] if len(stack.shape) == 2 else stack
        check_stack(text, stack, stack.shape[0], source.shape[0])
        darks = [np.asarray(s).reshape(source.shape[0], *stack.shape[-2:]) for s in stack]
    number = len(darks)
    if any(d.shape != source.shape or d.dtype != source.dtype for d in darks):
        raise ImportFailed(
            f"--darks {text}: {_kind(darks[0][0])}, but a frame of the sample is {source.shape[2]} x {source.shape[1]} "
            f"{source.dtype}; all must be alike. Give raw dark frames, or their mean as --black-level COUNTS"
        )

    def longer(values: NDArray[np.float64] | None, by: float) -> NDArray[np.float64] | None:
        return None if values is None else np.append(values, np.full(number, by))

    extended = replace(
        states,
        line=states.line + states.line[-1:] * number,
        role=states.role + ("dark",) * number,
        angles_deg={axis: np.append(values, np.full(number, np.nan)) for axis, values in states.angles_deg.items()},
        time_s=longer(states.time_s, np.nan),
        exposure_s=longer(exposures, float("nan") if exposures is None else float(exposures[0])),
        sigma=longer(states.sigma, float("nan") if states.sigma is None else float(states.sigma.mean())),
    )
    frames = source.frames
    return extended, replace(source, frames=lambda: chain(frames(), darks))


def _kind(image: Frame) -> str:
    return f"{image.shape[1]} x {image.shape[0]} {image.dtype}"


def read_sample(text: str) -> Sample:
    """Sample from `--sample`: air, mirror, unknown, or a file with 16 numbers (text or .npy)."""
    if text in ("air", "mirror", "unknown"):
        return Sample(kind=text)  # type: ignore[arg-type]
    path = Path(text)
    try:
        if path.suffix == ".npy":
            values = read_npy(path, ImportFailed, MOST_SAMPLE_BYTES).astype(float)
        else:
            values = np.array(read_text(path, ImportFailed, MOST_SAMPLE_BYTES).replace(",", " ").split(), dtype=float)
    except (ImportFailed, ValueError) as error:
        raise ImportFailed(
            f"--sample {text}: neither air, mirror, unknown nor a readable file of numbers ({one_line(error)})"
        ) from error
    if values.size != 16 or not np.all(np.isfinite(values)):
        raise ImportFailed(f"--sample {text}: a Mueller matrix has 16 finite numbers; found {values.size}")
    return Sample(kind="mueller", name=path.stem, mueller=tuple(float(v) for v in values.reshape(-1)))
