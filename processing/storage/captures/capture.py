"""Read a capture: header, states done, angles read back, frames in row blocks."""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.doors import parse_json
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.storage.captures.door import check_capture
from processing.storage.captures.frame_layout import Beams, Cells, FrameLayout
from processing.storage.captures.schema import SCHEMA_VERSION, CaptureHeader
from processing.storage.captures.segments import Segment, decode_lines, segments_of
from processing.storage.integrity.checksums import NONE, row_crc32, state_crc32, summed_values
from processing.storage.integrity.h5_door import (
    OpenH5,
    closed_if_damaged,
    damage_as,
    look_once,
    mark_of,
    open_h5,
    text_attribute,
)
from processing.storage.integrity.unpacking import KeptChunks, is_packed, read_rows
from processing.yaml_file import parse_yaml

#: What else a file can be, by its mark.
MADE_OF_CAPTURES = {"umov_product": "a product of `process`", "umov_table": "a scattering table"}


class CaptureError(ProcessError):
    """A capture cannot be used; the message says what was expected, what was found and what to do."""


class NotACapture(CaptureError):
    """A whole HDF5 file that is something else."""


class Capture(OpenH5):
    """One capture file, open for reading. States not marked done do not exist for a reader.

    Every state read is held against its checksum; CaptureError names one that was changed on the disc.

    Parameters
    ----------
    verify : False to look at damaged states as well, for `damaged_states`.
    by_super_pixel
        Of a polarization mosaic, give each super-pixel as one pixel with four channels. Images of several beams on one
        detector are channels always.

    Attributes
    ----------
    header : CaptureHeader
    role : tuple of str, for each state done
    angles_deg : dict of axis name to array (states,), degrees as read back

    Examples
    --------
    >>> with Capture("sphere.h5") as capture:
    ...     capture.header.wavelength_nm, capture.frame_shape, capture.angles_deg["psa"][2:4].tolist()
    (662.0, (24, 32), [0.0, 44.19])
    """

    def __init__(self, path: Path | str, *, verify: bool = True, by_super_pixel: bool = False) -> None:
        self.path = Path(path)
        self._verifying = verify
        self._by_super_pixel = by_super_pixel
        self._h5 = _open(self.path)
        with closed_if_damaged(self._h5, CaptureError, f"{self.path} is not a whole umov capture"):
            self._read()

    def _read(self) -> None:
        if "umov_schema" not in self._h5.attrs:
            source = next((name for mark, name in MADE_OF_CAPTURES.items() if mark in self._h5.attrs), None)
            raise NotACapture(
                f"{self.path} is HDF5 but no umov capture. If it comes from elsewhere, use `process import`."
                if source is None
                else f"{self.path} is {source}, and a capture is asked for: the file that it was made from."
            )
        version = int(self._h5.attrs["umov_schema"])
        if version != self._h5.attrs["umov_schema"] or version < 1:
            raise CaptureError(f"{self.path} has capture schema {self._h5.attrs['umov_schema']}, which never was.")
        if version > SCHEMA_VERSION:
            raise CaptureError(
                f"{self.path} has capture schema {version}; this program reads up to {SCHEMA_VERSION}. Update it."
            )
        entry = self._h5["entry"]
        self.header = CaptureHeader.model_validate_json(text_attribute(entry, "header_json"))
        look_once(self._h5, check_capture, entry, self.header)
        self.simulated: bool = bool(entry.attrs["simulated"])
        status = entry.attrs["status"]
        self.status: str = status.decode() if isinstance(status, bytes) else str(status)
        states = entry["states"]
        done = np.flatnonzero(states["done"][...])
        self.planned_states: int = states["done"].shape[0]
        self.done: NDArray[np.int64] = done
        self.role: tuple[str, ...] = tuple(r.decode() for r in states["role"][...][done])
        self.angles_deg: dict[str, NDArray[np.float64]] = {
            name: group["value"][...][done]
            for name, group in entry["instrument"].items()
            if group.attrs.get("NX_class") == "NXpositioner"
        }
        self._frames: h5py.Dataset = entry["instrument/detector/data"]
        self._kept = KeptChunks()
        self.layout = self._layout()
        self._contradictory: list[int] = []
        self._sums = self._verified_sums(entry) if version > 1 else None

    def _verified_sums(self, entry: h5py.Group) -> NDArray[np.uint32] | None:
        """Checksums of the rows (states done, channels, rows), None without any; the states' own are verified here."""
        crc = entry["states/crc32"][...][self.done]
        if np.all(crc == NONE):
            return None
        sums: NDArray[np.uint32] = entry["instrument/detector/row_crc32"][...][self.done]
        columns = {name: column[self.done] for name, column in summed_values(entry).items()}
        for k in np.flatnonzero(crc != NONE):
            values = {name: column[k] for name, column in columns.items()}
            if state_crc32(sums[k], values) != crc[k]:
                self._contradictory.append(int(k))
        if self._verifying and self._contradictory:
            raise self._changed(self._contradictory[0], "its angles or columns")
        return sums

    def _verify(self, state: int, rows: slice, counts: NDArray[Any]) -> None:
        if self._verifying and not self._rows_agree(state, rows, counts):
            raise self._changed(state, "its frame")

    def _rows_agree(self, state: int, rows: slice, counts: NDArray[Any]) -> bool:
        return self._sums is None or np.array_equal(row_crc32(counts), self._sums[state, :, rows])

    def row_sums(self) -> Iterator[NDArray[np.uint32]]:
        """Checksums of the rows of each state done, of its first channel; nothing where there are none."""
        if self._sums is not None:
            yield from self._sums[:, 0]

    def damaged_states(self) -> list[int]:
        """States done, by their number in the plan, that differ from their checksums; reads every frame."""
        return [
            int(self.done[k])
            for k in range(len(self.done))
            if k in self._contradictory or not self._rows_agree(k, slice(None), self._frames[int(self.done[k])])
        ]

    def _changed(self, state: int, part: str) -> CaptureError:
        return CaptureError(
            f"{self.path}: state {self.done[state]} was changed on the disc, {part} and the checksum differ. Take the "
            "file from a copy; `acquire verify` tells what else is damaged."
        )

    @property
    def name(self) -> str:
        """The file's name without its ending: so instrument files and results name a capture."""
        return self.path.stem

    @property
    def checked(self) -> bool:
        """Whether the file has checksums, so that a change on the disc is noticed."""
        return self._sums is not None

    def column(self, name: str) -> NDArray[Any]:
        """A column of the state table (exposure_s, host_time_s, ...), (states done,)."""
        return self.planned_column(name)[self.done]

    @property
    def full_scale_counts(self) -> float | None:
        """The largest count that the camera could send, as its frames have shown; None where nobody looked."""
        if not self.has_column("full_scale_counts"):
            return None
        counts = self.column("full_scale_counts")
        # The end may have been found in a later state: it held for the earlier ones too.
        return None if not np.isfinite(counts).any() else float(np.nanmin(counts))

    @property
    def reduces_to(self) -> Literal["mueller", "stokes"]:
        """What a reduction makes of it: a Stokes image of a mosaic, if nothing turns between the states.

        If an element before the mosaic or in the source turns, each super-pixel determines a part of the matrix.
        """
        if self.header.mosaic is None:
            return "mueller"
        if self.instrument is None:
            return "stokes"
        return "mueller" if self.turned_deg().keys() & set(self.instrument.axes) else "stokes"

    def turned_deg(self) -> dict[str, float]:
        """Degrees through which each axis was sent between the states with light; of those that moved."""
        light = np.array([role not in ("dark", "flat") for role in self.role], dtype=bool)
        targets = {axis: angles[self.done][light] for axis, angles in self.planned_targets_deg().items()}
        return {axis: span for axis, angles in targets.items() if angles.size and (span := float(np.ptp(angles))) > 0}

    def adapt(self, model: InstrumentModel) -> InstrumentModel:
        """The model with the mosaic as this capture's frames have it: an odd offset of the region shifts it."""
        if model.mosaic is None or self.header.mosaic is None:
            return model
        return model.model_copy(update={"mosaic": self.header.mosaic})

    @property
    def sigma(self) -> NDArray[np.float64] | None:
        """Standard deviation (states done,) of the noise of one value, counts; None if none is stated."""
        return np.asarray(self.column("sigma"), dtype=float) if "sigma" in self._h5["entry/states"] else None

    @property
    def start_time(self) -> str:
        """When the capture began, ISO 8601."""
        with self._damage():
            return str(self._h5["entry/start_time"].asstr()[()])

    @property
    def camera_nodes(self) -> dict[str, str]:
        """Every feature of the camera with its value when the capture began; empty where none were kept."""
        if "entry/camera_nodes" not in self._h5:
            return {}
        with self._damage():
            nodes = parse_json(self._h5["entry/camera_nodes/data"][()], f"{self.path}: camera nodes", CaptureError)
            return dict(nodes)

    def has_column(self, name: str) -> bool:
        """False for a column that the file is too old for."""
        return name in self._h5["entry/states"]

    def planned_column(self, name: str) -> NDArray[Any]:
        """A column of the state table for all planned states, done or not. Raises CaptureError for an unknown name."""
        if name not in self._h5["entry/states"]:
            raise CaptureError(f"{self.path} has no column {name!r}; it has: {', '.join(self._h5['entry/states'])}.")
        with self._damage():
            return np.asarray(self._h5[f"entry/states/{name}"][...])

    def planned_targets_deg(self) -> dict[str, NDArray[np.float64]]:
        """Axis name to target angles (states,) in degrees, for all planned states, done or not."""
        with self._damage():
            return {name: self._h5[f"entry/instrument/{name}/target_value"][...] for name in self.angles_deg}

    def _layout(self) -> FrameLayout | None:
        layout: FrameLayout | None = None
        if self.header.beams:
            layout = Beams(self.header.beams)
        elif self._by_super_pixel and self.header.mosaic and self.instrument:
            layout = Cells(self.header.mosaic, tuple(c.name for c in self.instrument.channels))
        if layout is not None:
            layout.shape(self.stored_shape)
        return layout

    @property
    def stored_shape(self) -> tuple[int, int]:
        """(rows, columns) of a frame as the detector gave it."""
        return int(self._frames.shape[2]), int(self._frames.shape[3])

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(rows, columns) of the image of one channel."""
        return self.stored_shape if self.layout is None else self.layout.shape(self.stored_shape)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the spatially separate channels; one, "mosaic", for a mosaic."""
        return self.header.channels if self.layout is None else self.layout.channels

    @property
    def channels(self) -> int:
        """Number of spatially separate channels (1 for a mosaic)."""
        return len(self.channel_names)

    def states_with(self, role: str) -> NDArray[np.int64]:
        """Positions (n,), among the states done, of those with the role."""
        return np.flatnonzero([r == role for r in self.role])

    def frames(self, state: int, rows: slice = slice(None)) -> NDArray[Any]:
        """Counts (channels, rows, columns) of one state done, as stored. Raises IndexError where there are fewer."""
        number = int(self.done[state])
        stored = rows if self.layout is None or rows == slice(None) else self.layout.stored_rows(rows)
        with self._damage():
            counts = read_rows(self._frames, stored, (number,), self._kept)
        self._verify(state, stored, counts)
        return counts if self.layout is None else self.layout.split(counts[0])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the counts as stored."""
        dtype: np.dtype[Any] = self._frames.dtype
        return dtype

    @property
    def integer_counts(self) -> bool:
        """Whether frames are whole counts (a camera), not floating numbers (imported fluxes)."""
        return self.dtype.kind in "ui"

    def read_block(self, states: NDArray[np.int64], rows: slice, out: NDArray[Any]) -> None:
        """Fill `out` (len(states), channels, rows, columns) with counts of states done, as stored."""
        if self.layout is not None:
            for k, state in enumerate(states):
                out[k] = self.frames(int(state), rows)
            return
        with self._damage():
            packed = is_packed(self._frames)
            for k, state in enumerate(states):
                number = int(self.done[state])
                if packed:
                    out[k] = read_rows(self._frames, rows, (number,), self._kept)
                else:
                    self._frames.read_direct(out, np.s_[number, :, rows, :], np.s_[k])
                self._verify(int(state), rows, out[k])

    def row_blocks(self, pixels: int = 1 << 17) -> Iterator[slice]:
        """Row slices of about `pixels` pixels, an even number of rows each (mosaics stay whole)."""
        height, width = self.frame_shape
        step = max(2, pixels // max(width, 1) // 2 * 2)
        for start in range(0, height, step):
            yield slice(start, min(start + step, height))

    @cached_property
    def instrument(self) -> InstrumentModel | None:
        """The instrument model stored with the capture, resolved at its wavelength."""
        if not self.header.instrument_yaml:
            return None
        model = parse_yaml(self.header.instrument_yaml, InstrumentModel, source=f"{self.path}: instrument model")
        return model.at(self.header.wavelength_nm)

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """The runs that took states of this capture, one after another; the light may jump between them."""
        if "segments" not in self._h5["entry"]:
            return segments_of([], self.done)
        with self._damage():
            records, _ = decode_lines(self._h5["entry/segments/json"][...].tobytes())
            return segments_of(records, self.column("segment"))

    @cached_property
    def run_of_states(self) -> NDArray[np.int64]:
        """Number (states done,), from 0, of the run that took each state."""
        run = np.zeros(len(self.done), dtype=np.int64)
        for segment in self.segments:
            run[segment.states] = segment.number
        return run

    @cached_property
    def closing(self) -> dict[str, Any]:
        """Closing record: end time, time ledger, stream statistics, messages; empty if not sealed."""
        with self._damage():
            raw = self._h5["entry/closing/json"][...].tobytes().rstrip(b"\0")
            closing = parse_json(raw, f"{self.path}: closing record", CaptureError) if raw else {}
            return dict(closing)

    def _damage(self) -> AbstractContextManager[None]:
        return damage_as(CaptureError, f"{self.path} is damaged")


def made_of_captures(path: Path) -> bool:
    """Whether `process` made the file of captures: a product, or a table, which lies next to them."""
    return any(mark_of(path, mark) is not None for mark in MADE_OF_CAPTURES)


def _open(path: Path) -> h5py.File:
    if not path.exists():
        raise CaptureError(f"{path}: no such file. Check the path; `acquire` prints it at the end of a run.")
    hint = "Nothing was changed. If a run was interrupted, its states are in the .partial file beside it."
    return open_h5(path, CaptureError, hint)


def full_model(path: Path, instrument: Path | None) -> InstrumentModel:
    """The instrument at all wavelengths that it has: of its file, without one as a capture holds it.

    Raises CaptureError: the capture holds no model.
    """
    if instrument is not None:
        return InstrumentModel.load(instrument)
    with Capture(path) as capture:
        text = capture.header.instrument_yaml
    if not text:
        raise CaptureError(f"{path} holds no instrument model. Give one with --instrument FILE.")
    return parse_yaml(text, InstrumentModel, source=f"{path}: instrument model")
