"""Layout of a capture file, and its creation with all space allocated up front (docs/capture-format.md).

Both writers use it: `acquisition` state by state from the bench, `process import` from files of others.
"""

import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, Literal, Self

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from processing.doors import is_line
from processing.section import FiniteSection
from processing.storage.captures.nexus import (
    PIXEL_AXES,
    add_group,
    add_scales,
    attach,
    declare,
    default_plot,
    describe_light,
    link_coordinate,
)

#: 2 added segments and checksums; a file of version 1 is read, but not gone on with.
SCHEMA_VERSION = 2

Status = Literal["running", "complete", "aborted", "failed"]
SampleKind = Literal["air", "mirror", "mueller", "unknown"]

#: The longest status; shorter ones are padded, so that a status is replaced in its place.
STATUS_TYPE = h5py.string_dtype("ascii", 8)
#: Bytes that the closing record and the records of all segments may have.
CLOSING_BYTES = 256 * 1024
SEGMENTS_BYTES = 512 * 1024

#: One row of /entry/states a state; filled when the state is taken.
STATE_COLUMNS: dict[str, Any] = {
    "done": np.uint8,
    "segment": np.int32,
    "crc32": np.int64,
    "exposure_s": np.float64,
    "repeats": np.int32,
    "host_time_s": np.float64,
    "camera_time_ns": np.int64,
    "frame_id": np.int64,
    "retakes": np.int32,
    "saturated_fraction": np.float64,
    "near_black_fraction": np.float64,
    "monitor": np.float64,
    "camera_temperature_c": np.float64,
    "full_scale_counts": np.float64,
}
#: Units of the columns; what is not named is a plain number.
COLUMN_UNITS = {
    "exposure_s": "s",
    "host_time_s": "s",
    "camera_time_ns": "ns",
    "monitor": "count/s",
    "camera_temperature_c": "degC",
    "full_scale_counts": "count",
}
#: Units of what is known about the detector.
DETECTOR_UNITS = {
    "black_level_counts": "count",
    "gain_e_per_count": "1/count",
    "read_noise_e": "",
    "full_well_e": "",
    "bits": "",
}
#: What a column holds before its state is taken, where it is not NaN or zero.
EMPTY: dict[str, int] = {"repeats": 1, "crc32": -1}

#: What else stands in /entry/instrument, so that no axis can have the name.
NOT_AXES = frozenset({"beam", "beam_light", "detector", "detector_camera", "omega", "omega_deg", "name"})


def _line(text: str) -> str:
    if not is_line(text):
        raise ValueError("control characters in a text")
    return text


def _rectangular(rows: tuple[tuple[str, ...], ...] | None) -> tuple[tuple[str, ...], ...] | None:
    if rows is not None and (not rows or not rows[0] or len({len(row) for row in rows}) > 1):
        raise ValueError("its rows are not all equally long")
    return rows


#: A text of one line that a terminal shows as it is.
Line = Annotated[str, AfterValidator(_line)]
#: What lies before each pixel of a cell of the sensor, row by row.
Cell = Annotated[tuple[tuple[Line, ...], ...] | None, AfterValidator(_rectangular)]


class Sample(FiniteSection):
    """What stood at the centre. `mueller` (16 numbers, row-major) goes with kind "mueller".

    Air and mirror are known up to one throughput for each pixel.
    """

    kind: SampleKind = Field(default="unknown", description="unknown, or known: air, mirror, or a given Mueller matrix")
    name: Line = Field(default="", description="name that messages and other files use")
    mueller: Annotated[tuple[float, ...], Field(min_length=16, max_length=16)] | None = Field(
        default=None, description="16 numbers, row by row, for kind mueller"
    )

    @model_validator(mode="after")
    def _matrix_goes_with_its_kind(self) -> Self:
        if (self.kind == "mueller") != (self.mueller is not None):
            raise ValueError("kind mueller and its 16 numbers under `mueller` go together")
        return self


class Detector(FiniteSection):
    """Noise-relevant constants of the detector; counts are right-aligned to `bits`.

    variance in counts^2 = (counts - black_level) / gain_e_per_count + (read_noise_e / gain_e_per_count)^2.
    None means not known: error bars then come from the residual, and say so.
    """

    black_level_counts: float = Field(default=0.0, description="counts without light")
    gain_e_per_count: float | None = Field(
        default=None, gt=0, description="electrons for one count; without it error bars come from the residual"
    )
    read_noise_e: float | None = Field(default=None, ge=0, description="read noise, electrons")
    full_well_e: float | None = Field(default=None, gt=0, description="electrons that a pixel holds")
    bits: int | None = Field(default=None, ge=1, le=32, description="bits of a count; full scale is 2**bits - 1")

    @property
    def range_counts(self) -> float | None:
        """Counts from black to full scale; None where the bits are not known."""
        return None if self.bits is None else float(2**self.bits - 1) - self.black_level_counts


class CaptureHeader(FiniteSection):
    """Everything about a capture that is known before its first state."""

    title: Line
    simulated: bool
    mode: Line
    wavelength_nm: float = Field(gt=0)
    omega_deg: float | None = None
    illumination: Line | None = None
    sample: Sample = Sample()
    detector: Detector = Detector()
    channels: tuple[Line, ...] = ("camera",)
    mosaic: Cell = None
    #: Names of the channels whose images lie side by side in each frame.
    beams: tuple[Line, ...] | None = None
    instrument_yaml: str = ""
    plan_yaml: str = ""
    rig_yaml: str = ""
    camera_settings_json: str = "{}"
    devices_json: str = "{}"
    versions: dict[Line, Line] = Field(default_factory=dict)
    seed: int | None = Field(default=None, ge=0, lt=1 << 63)
    #: Axes whose targets were moved into their travel by whole multiples of so many degrees.
    folded_deg: dict[str, float] = Field(default_factory=dict)
    #: Axes whose positions are volts, with the positions that have a name.
    voltages: dict[Line, dict[Line, float]] = Field(default_factory=dict)
    #: Every feature of the camera with its value when the capture began; in a note of its own, not in header_json.
    camera_nodes: dict[str, str] = Field(default={}, exclude=True)
    #: Colour before each pixel from the first of the frames on, for a sensor with a colour filter.
    colours: Cell = None


def create_layout(
    h5: h5py.File,
    header: CaptureHeader,
    target_deg: dict[str, NDArray[np.float64]],
    role: tuple[str, ...],
    *,
    frame_shape: tuple[int, int],
    dtype: Any,
    start_time: str,
    frames: Callable[[h5py.Group, str, tuple[int, ...], Any], h5py.Dataset] | None = None,
) -> None:
    """Create every group and dataset of a capture, fixed shape, uncompressed, space allocated early.

    Parameters
    ----------
    h5 : file open for writing, empty.
    target_deg : for each axis, target angles (N,) in degrees.
    role : N roles: "dark", "flat", "air" or "sample".
    frame_shape : (rows, columns) of one frame of one channel.
    dtype : of the frames; uint16 from a camera, floating for imported fluxes.
    start_time : ISO 8601.
    frames : makes the dataset of the frames, where it is not to be as said.
    """
    n, c = len(role), len(header.channels)
    h5.attrs["default"] = "entry"
    h5.attrs["umov_schema"] = SCHEMA_VERSION
    entry = add_group(h5, "entry", "NXentry")
    entry.attrs["default"] = "data"
    entry.attrs["simulated"] = header.simulated
    entry.attrs.create("status", b"running", dtype=STATUS_TYPE)
    for key in ("title", "mode"):
        entry[key] = getattr(header, key)
    entry["start_time"] = start_time
    entry.attrs["header_json"] = header.model_dump_json()
    declare(entry)
    # In the entry, where every group below finds them; the plot has them under the same names.
    add_scales(entry, {"state": n, "channel": c, **dict(zip(PIXEL_AXES, frame_shape, strict=True))})

    instrument = describe_light(entry, header.wavelength_nm, header.sample.name or header.sample.kind)
    if header.omega_deg is not None:
        instrument["omega_deg"] = float(header.omega_deg)
        instrument["omega_deg"].attrs["units"] = "degree"
    for axis, target in target_deg.items():
        _positioner(entry, axis, np.asarray(target, dtype=np.float64), header.voltages.get(axis))
    create = frames or partial(_allocated, chunks=(1, 1, *frame_shape))
    _detector(entry, header, create(entry["instrument/detector"], "data", (n, c, *frame_shape), dtype))

    states = add_group(entry, "states", "NXcollection")
    # Text of one length: dask cannot divide columns of another kind.
    states["role"] = np.array(role, dtype="S")
    attach(states["role"], entry, ["state"])
    for name, kind in STATE_COLUMNS.items():
        empty = np.nan if np.issubdtype(kind, np.floating) else EMPTY.get(name, 0)
        column = _column(states, name, n, kind, fill=empty)
        column.attrs["units"] = COLUMN_UNITS.get(name, "")
        attach(column, entry, ["state"])

    for name, kind, text in (
        ("plan", "yaml", header.plan_yaml),
        ("rig", "yaml", header.rig_yaml),
        ("instrument_model", "yaml", header.instrument_yaml),
        ("camera_nodes", "json", json.dumps(header.camera_nodes)),
    ):
        note = add_group(entry, name, "NXnote")
        note["type"] = f"application/{kind}"
        # As bytes, which is what a note holds for NeXus.
        _put_text(note, "data", text.encode())
    positions = {position_column(axis, axis in header.voltages)[0]: axis for axis in target_deg}
    _plot(entry, header.title, positions)


def reserve_texts(entry: h5py.Group, begin: bytes) -> dict[h5py.Dataset, int]:
    """Take the space of what is written later: the journal of segments and the closing record.

    The journal has a line for the begin and the end of each segment of the run, the record end time, ledger, statistics
    and messages.

    Returns
    -------
    Each dataset with the bytes of its text, one at least; the dataset is as long as its room until the file is told.
    """
    reserved = {}
    for name, size, text in (("segments", SEGMENTS_BYTES, begin), ("closing", CLOSING_BYTES, b"")):
        group = add_group(entry, name, "NXcollection")
        dataset = _allocated(group, "json", (), h5py.string_dtype("utf-8", size), chunks=None)
        dataset[()] = text
        reserved[dataset] = max(len(text), 1)
    return reserved


def put_record(entry: h5py.Group, name: str, raw: bytes) -> None:
    """Write the journal of segments or the closing record, in JSON, into a file that takes no more states."""
    _put_text(add_group(entry, name, "NXcollection"), "json", raw)


def _put_text(group: h5py.Group, name: str, raw: bytes) -> None:
    group.create_dataset(name, data=raw, dtype=h5py.string_dtype("utf-8", max(len(raw), 1)))


def _positioner(
    entry: h5py.Group, axis: str, target_deg: NDArray[np.float64], voltages: Mapping[str, float] | None
) -> None:
    """An axis: where it was to be and where it was, in each state; of volts with the names that they have."""
    positioner = add_group(entry["instrument"], axis, "NXpositioner")
    positioner["name"] = axis
    _column(positioner, "value", len(target_deg), np.float64, fill=np.nan)
    _column(positioner, "raw_value", len(target_deg), np.float64, fill=np.nan)
    positioner.create_dataset("target_value", data=target_deg)
    _, unit = position_column(axis, voltages is not None)
    for name, units in (("value", unit), ("raw_value", "count"), ("target_value", unit)):
        positioner[name].attrs["units"] = units
        attach(positioner[name], entry, ["state"])
    positioner["value"].attrs["long_name"] = f"{axis}, as read back"
    if voltages:
        named = {volts: name for name, volts in voltages.items()}
        positioner["state_name"] = np.array([named.get(volts, "").encode() for volts in target_deg.tolist()], dtype="S")
        attach(positioner["state_name"], entry, ["state"])


def _detector(entry: h5py.Group, header: CaptureHeader, frames: h5py.Dataset) -> None:
    """The frames (state, channel, row, column), with the checksums of their rows, and what is known of the noise."""
    detector = frames.parent
    frames.attrs.update({"long_name": "counts (state, channel, row, column)", "units": "count"})
    sums = _allocated(detector, "row_crc32", frames.shape[:3], np.uint32, chunks=None)
    sums.attrs["units"] = ""
    for dataset in (frames, sums):
        attach(dataset, entry, ["state", "channel", *PIXEL_AXES])
    detector["channels"] = np.array([name.encode() for name in header.channels], dtype="S")
    attach(detector["channels"], entry, ["channel"])
    for key, units in DETECTOR_UNITS.items():
        value = getattr(header.detector, key)
        if value is not None:
            detector[key] = value
            detector[key].attrs["units"] = units


def position_column(axis: str, is_voltage: bool) -> tuple[str, str]:
    """What labelled data and documents call the positions of an axis, and their unit."""
    return (f"{axis}_V", "V") if is_voltage else (f"{axis}_deg", "degree")


def _plot(entry: h5py.Group, title: str, positions: Mapping[str, str]) -> None:
    """The default plot: the frames over state, channel and pixel, with the axes' positions as further coordinates."""
    data = add_group(entry, "data", "NXdata")
    dimensions = ("state", "channel", *PIXEL_AXES)
    for name in dimensions:
        data[name] = entry[name]
    data["data"] = h5py.SoftLink("/entry/instrument/detector/data")
    default_plot(data, "data", dimensions, title)
    further = {name: f"/entry/instrument/{axis}/value" for name, axis in positions.items()}
    further |= {name: f"/entry/states/{name}" for name in ("role", "exposure_s", "host_time_s", "done")}
    for name, target in further.items():
        link_coordinate(data, name, target, dimensions.index("state"))
    link_coordinate(data, "channel_name", "/entry/instrument/detector/channels", dimensions.index("channel"))
    # Of the CF conventions: which variables are coordinates although no dimension has their name.
    data["data"].attrs.update(
        {"target": "/entry/instrument/detector/data", "coordinates": " ".join([*further, "channel_name"])}
    )


def write_closing(h5: h5py.File, status: Status, closing: Mapping[str, Any]) -> None:
    """Write the closing record (end time, time ledger, stream statistics, messages) and the status.

    A record that is too long loses the newest entries of its longest lists, and says so under `left_out`.
    """
    put_record(h5["entry"], "closing", fitted_json(closing, room=CLOSING_BYTES))
    write_status(h5, status)


def write_status(h5: h5py.File, status: Status) -> None:
    """Overwrite the status in the file; nothing else changes."""
    h5["entry"].attrs.modify("status", np.array(status.encode(), dtype=STATUS_TYPE))


def fitted_json(closing: Mapping[str, Any], room: int) -> bytes:
    """JSON in at most `room` bytes; `left_out` counts the list entries, characters and values that were cut.

    Where not even that fits it is an empty record.
    """
    record, left_out = dict(closing), dict[str, int]()
    while len(raw := json_bytes(record)) > room:
        names = set(record) - {"left_out"}
        if not names:
            return b"{}"
        longest = max(names, key=lambda name: len(json_bytes(record[name])))
        value = record.pop(longest)
        cut = 1
        if isinstance(value, (list, str)) and len(value) > 1:
            cut = -(-len(value) // 8)
            record[longest] = value[:-cut]
        left_out[longest] = left_out.get(longest, 0) + cut
        record["left_out"] = left_out
    return raw


def json_bytes(value: Any) -> bytes:
    """JSON of plain values; what is not plain becomes its text."""
    # A lone surrogate, from the name of a file, becomes an escape that JSON reads.
    return json.dumps(value, ensure_ascii=False, default=str).encode(errors="backslashreplace")


def _column(parent: h5py.Group, name: str, n: int, dtype: Any, *, fill: Any) -> h5py.Dataset:
    column = _allocated(parent, name, (n,), dtype, chunks=None)
    column[...] = np.full(n, fill, dtype=dtype)
    return column


def _allocated(
    parent: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, *, chunks: tuple[int, ...] | None
) -> h5py.Dataset:
    # Early allocation: a full disc fails here, never in the middle of a run.
    create = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    create.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    create.set_fill_time(h5py.h5d.FILL_TIME_NEVER if chunks else h5py.h5d.FILL_TIME_IFSET)
    if chunks:
        create.set_chunk(chunks)
    space = h5py.h5s.create_simple(shape) if shape else h5py.h5s.create(h5py.h5s.SCALAR)
    kind = h5py.h5t.py_create(np.dtype(dtype), logical=True)
    return h5py.Dataset(h5py.h5d.create(parent.id, name.encode(), kind, space, dcpl=create))
