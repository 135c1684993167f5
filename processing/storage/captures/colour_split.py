"""A capture of a sensor with a colour filter, split into one capture for each colour.

On a colour polarization sensor (Sony IMX250MYR) each colour of the Bayer pattern covers a whole super-pixel of four
polarizers, so the pixels of one colour are a plain polarization mosaic of half the rows and columns. Nothing is
interpolated between colours: light of one wavelength reaches the colours in very different strength.
"""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np

from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.captures.schema import STATE_COLUMNS, create_layout, write_closing
from processing.storage.products.provenance import content_of, file_identity
from processing.yaml_file import dump_yaml, parse_yaml

Colours = tuple[tuple[str, ...], ...]


def split_colours(path: Path, folder: Path) -> tuple[list[Path], bool]:
    """Write a capture for each colour, the two greens apart.

    Returns their paths, and whether all of them existed, made of the same capture by the same version. Raises
    ProcessError: the capture has no colour filter, the frames are too small, or another file has one of the names.
    """
    with Capture(path) as capture:
        colours = capture.header.colours
        if colours is None:
            raise ProcessError(f"{path} has no colour filter; reduce it as it is.")
        cell = len(colours) // 2
        parts = _parts(colours, cell, capture.frame_shape)
        files = {name: folder / f"{path.stem}.{name}.h5" for name in parts}
        content = content_of(file_identity(path))
        if all(_is_part(file, content) for file in files.values()):
            return list(files.values()), True
        existing = [str(file) for file in files.values() if file.exists()]
        if existing:
            raise ProcessError(f"{', '.join(existing)} exists. Give another --out.")
        folder.mkdir(parents=True, exist_ok=True)
        for name, (rows, columns) in parts.items():
            _write(capture, name, files[name], rows, columns=columns, content=content)
    return list(files.values()), False


def _is_part(path: Path, content: str | None) -> bool:
    """Whether a file is a part of the capture with this content, written by this version."""
    if not path.is_file():
        return False
    try:
        with Capture(path) as part:
            return part.closing.get("of_content") == content and part.header.versions.get("umov") == version("umov")
    except CaptureError:
        return False


def _parts(colours: Colours, cell: int, shape: tuple[int, int]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Row and column indices of each part, from the first whole cell of the pattern on."""
    period = 2 * cell
    top = _start(["".join(row) for row in colours], cell)
    left = _start(["".join(column) for column in zip(*colours, strict=True)], cell)
    height, width = (shape[0] - top) // period, (shape[1] - left) // period
    if min(height, width) < 2:
        raise ProcessError(f"frames of {shape} hold less than 2 x 2 colour cells of {period} pixels.")
    greens = iter(("green_a", "green_b"))
    parts = {}
    for r in (0, 1):
        for c in (0, 1):
            row, column = top + r * cell, left + c * cell
            name = colours[row % period][column % period]
            rows = (row + period * np.arange(height)[:, None] + np.arange(cell)).ravel()
            columns = (column + period * np.arange(width)[:, None] + np.arange(cell)).ravel()
            parts[next(greens) if name == "green" else name] = (rows, columns)
    return parts


def _start(lines: Sequence[str], cell: int) -> int:
    """Lines to leave out until a cell begins: a frame may begin in the middle of one."""
    return next((k for k in range(1, cell) if lines[k] != lines[k - 1]), 0)


def _write(
    capture: Capture, name: str, out: Path, rows: np.ndarray, *, columns: np.ndarray, content: str | None
) -> None:
    header, done = capture.header, capture.done
    mosaic = header.mosaic
    if mosaic is not None:
        mosaic = tuple(tuple(mosaic[r % len(mosaic)][c % len(mosaic[0])] for c in columns[:2]) for r in rows[:2])
    text = header.instrument_yaml
    if text:
        model = parse_yaml(text, InstrumentModel, source=f"{capture.path}: instrument model")
        text = dump_yaml(model.model_copy(update={"mosaic": mosaic}))
    part = header.model_copy(
        update={
            "instrument_yaml": text,
            "title": f"{header.title}, {name}",
            "colours": None,
            "mosaic": mosaic,
            "versions": header.versions | {"umov": version("umov")},
            "camera_nodes": capture.camera_nodes,
        }
    )
    targets = {axis: angles[done] for axis, angles in capture.planned_targets_deg().items()}
    role = tuple(capture.role)
    with h5py.File(out, "w") as h5:
        create_layout(
            h5,
            part,
            targets,
            role,
            frame_shape=(len(rows), len(columns)),
            dtype=capture.dtype,
            start_time=capture.start_time,
        )
        for state in range(len(done)):
            h5["entry/instrument/detector/data"][state] = capture.frames(state)[:, rows][:, :, columns]
        for axis, angles in capture.angles_deg.items():
            h5[f"entry/instrument/{axis}/value"][...] = angles
        for column in STATE_COLUMNS.keys() - {"done", "crc32", "segment"}:
            if capture.has_column(column):
                h5[f"entry/states/{column}"][...] = capture.column(column)
        h5["entry/states/done"][...] = 1
        write_closing(h5, "complete", {"colour": name, "of": str(capture.path), "of_content": content})
