"""Read a capture: header, states done, angles read back, frames in row blocks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.storage.capture_schema import SCHEMA_VERSION, CaptureHeader
from processing.yaml_file import parse_yaml


class CaptureError(ProcessError):
    """A capture cannot be used; the message says what was expected, what was found and what to do."""


class Capture:
    """One capture file, open for reading. States not marked done do not exist for a reader.

    Attributes
    ----------
    header : CaptureHeader
    role : tuple of str, for each state done
    angles_deg : dict of axis name to array (states,), degrees as read back
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._h5 = _open(self.path)
        try:
            self._read()
        except CaptureError:
            self._h5.close()
            raise
        except (KeyError, OSError, ValidationError, ValueError) as error:
            self._h5.close()
            raise CaptureError(
                f"{self.path} is not a whole umov capture ({error}). If it comes from elsewhere, use `process import`."
            ) from error

    def _read(self) -> None:
        if "umov_schema" not in self._h5.attrs:
            raise CaptureError(
                f"{self.path} is HDF5 but no umov capture. If it comes from elsewhere, use `process import`."
            )
        version = int(self._h5.attrs["umov_schema"])
        if version > SCHEMA_VERSION:
            raise CaptureError(
                f"{self.path} has capture schema {version}; this program reads up to {SCHEMA_VERSION}. Update it."
            )
        entry = self._h5["entry"]
        self.header = CaptureHeader.model_validate_json(entry.attrs["header_json"])
        self.simulated: bool = bool(entry.attrs["simulated"])
        self.status: str = str(entry.attrs["status"])
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

    def column(self, name: str) -> NDArray[Any]:
        """A column of the state table (exposure_s, host_time_s, ...) for the states done."""
        return np.asarray(self._h5[f"entry/states/{name}"][...][self.done])

    def planned_column(self, name: str) -> NDArray[Any]:
        """A column of the state table for all planned states, done or not."""
        return np.asarray(self._h5[f"entry/states/{name}"][...])

    def planned_targets_deg(self) -> dict[str, NDArray[np.float64]]:
        """Target angles of each axis for all planned states, done or not."""
        return {name: self._h5[f"entry/instrument/{name}/target_value"][...] for name in self.angles_deg}

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(rows, columns) of one frame."""
        return int(self._frames.shape[2]), int(self._frames.shape[3])

    @property
    def channels(self) -> int:
        """Number of spatially separate channels (1 for a mosaic)."""
        return int(self._frames.shape[1])

    def states_with(self, role: str) -> NDArray[np.int64]:
        """Positions, among the states done, of those with the role."""
        return np.flatnonzero([r == role for r in self.role])

    def frames(self, state: int, rows: slice = slice(None)) -> NDArray[Any]:
        """Counts (channels, rows, columns) of one state done, as stored."""
        return np.asarray(self._frames[int(self.done[state]), :, rows, :])

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
        for k, state in enumerate(states):
            self._frames.read_direct(out, np.s_[int(self.done[state]), :, rows, :], np.s_[k])

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
    def closing(self) -> dict[str, Any]:
        """Closing record: end time, time ledger, stream statistics, messages; empty if not sealed."""
        raw = self._h5["entry/closing/json"][...].tobytes().rstrip(b"\0")
        return json.loads(raw) if raw else {}

    def close(self) -> None:
        """Close the file."""
        self._h5.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def _open(path: Path) -> h5py.File:
    if not path.exists():
        raise CaptureError(f"{path}: no such file. Check the path; `acquire` prints it at the end of a run.")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise CaptureError(
            f"{path} cannot be opened as HDF5 ({error}). It is truncated or not a capture; "
            "nothing was changed. If a run was interrupted, its states are in the .partial file beside it."
        ) from error
