"""Frames of all states of an import: of a folder, of pictures, of a stack, or the fluxes of a table."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import thread_count
from processing.doors import one_line, require_picture
from processing.storage.formats.foreign_arrays import FrameFiles, ImportFailed, frame_files, missing_numbers
from processing.storage.formats.frame_files import PAGED, check_stack, open_stack, read_frame
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.state_csv import StatesFile

Frame = NDArray[Any]


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


def places_of(stack: str | None, frames: FrameFiles | None) -> tuple[Place, ...]:
    """Frames of a folder, a picture, or the pages of a picture; empty for other stacks."""
    if stack is None or frames is not None:
        return tuple((file, None) for file in frames.files) if frames else ()
    file = Path(stack)
    if file.suffix.lower() not in (*PAGED, ".png"):
        return ()
    pages = require_picture(file, ImportFailed)
    return tuple((file, page) for page in range(pages)) if pages > 1 else ((file, None),)


def dimensions_of(stack: str) -> int:
    return len(open_stack(stack, None).shape)


def states_of_stack(stack: str, channels: int) -> int:
    """States of a stack in which nothing turns."""
    shape = open_stack(stack, None).shape
    return int(shape[0]) if len(shape) == 4 or (len(shape) == 3 and channels == 1) else 1


def require_one_source(request: ImportRequest, states: StatesFile, *, has_folder: bool) -> None:
    sources = {
        "the column `file`": states.files is not None,
        "--stack": request.stack is not None and (states.files is None or not has_folder),
        "columns `channel_<name>`": bool(states.channels),
    }
    ways = [name for name, present in sources.items() if present]
    if len(ways) != 1:
        text = " and ".join(ways) or "none of them"
        raise ImportFailed(f"{states.path}: frames come from exactly one of {', '.join(sources)}; found {text}.")


def _plain(name: str) -> str:
    """The name of a file without its folder, as the table of another system may write it."""
    return name.replace("\\", "/").rpartition("/")[2]


def named_files(request: ImportRequest, states: StatesFile, frames: FrameFiles) -> tuple[Place, ...]:
    """The files of a folder that a column of the table names, with their ending or without."""
    of_name = {file.stem: file for file in frames.files} | {file.name: file for file in frames.files}
    absent = [(line, n) for line, n in zip(states.line, states.files or (), strict=True) if _plain(n) not in of_name]
    if absent:
        line, name = absent[0]
        raise ImportFailed(f"{states.path}:{line}: column file: {request.stack} has no frame {one_line(name)}")
    return tuple((of_name[_plain(name)], None) for name in states.files or ())


def require_order(request: ImportRequest, states: StatesFile, frames: FrameFiles) -> None:
    """Raise ImportFailed where there is not a frame for each state, or a column names the files in another order."""
    names = {file.name for file in frames.files} | {file.stem for file in frames.files}
    for column, cells in states.ignored.items():
        plain = [_plain(cell) for cell in cells]
        if set(plain) <= names and len(set(plain)) == len(plain):
            in_order = [n in (f.name, f.stem) for n, f in zip(plain, frames.files, strict=False)]
            if not all(in_order) or len(in_order) != len(frames.files):
                raise ImportFailed(
                    f"{states.path}: column {column!r} names the frames of {request.stack} in an order of its own, or "
                    f"not all of them. Add --columns 'file={column}'"
                )
    if len(frames.files) != len(states):
        gap = missing_numbers(frames.files)
        numbers = f"; their names leave out {one_line(gap, 60)}" if gap else ""
        often, more = divmod(len(frames.files), len(states))
        raise ImportFailed(
            f"{request.stack}: {len(frames.files)} frames for {len(states)} states of {states.path}{numbers}. "
            + (f"If each state has {often} frames, one after the other, add --repeats {often}. " if not more else "")
            + "Choose frames by a pattern, as --stack 'FOLDER/img_*.tif', or by a column of the table: --columns "
            "file=COLUMN"
        )


def source_of(
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


def with_darks(text: str, states: StatesFile, source: FrameSource) -> tuple[StatesFile, FrameSource]:
    """The states, and after them the dark frames of another file or folder."""
    exposures = states.exposure_s
    if exposures is not None and np.ptp(exposures) > 0:
        raise ImportFailed(f"--darks {text}: the states have several exposures; give darks their own rows in the CSV")
    places = places_of(text, frame_files(text))
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
