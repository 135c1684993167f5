"""The files of RGB950's own program, AxoStep: raw frames (.rmmd) read, Mueller images (.cmmi, .bmmi) read and written.

Big-endian 32-bit words, from the lab's public format sheet (Polarization-Lab/RGB950) and reader (MMViewPy). Not yet
tried on a file from the instrument: two public readers even disagree on the length of the header, so it is told from
the file.
"""

import struct
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.doors import require_file
from processing.errors import ProcessError

EPOCH = datetime(1904, 1, 1, tzinfo=UTC)

#: Metadata words after the reduced parameters, in file order; the date takes two.
METADATA = (
    *("wavelength_nm", "number_averaged", "x_min", "x_step", "x_count", "y_min", "y_step", "y_count"),
    *("robot_x", "robot_y", "tilt", "rotation", "correction_1", "correction_2", "correction_3"),
    *("shutter_ms", "camera_gain", "focus", "magnification", "f_number", "percent_saturation"),
    *("date", "psg_steps"),
)


class AxoStepError(ProcessError):
    """A file does not have the layout that its name and header promise."""


@dataclass(frozen=True)
class RawFrames:
    """Frames of a .rmmd file.

    Attributes
    ----------
    frames : (N, rows, columns) int32, counts, top row first.
    header : word 0, meaning unknown.
    header_words : 4 or 5, words before the first frame.
    extra : the word before the first frame where there are 5.
    """

    frames: NDArray[np.int32]
    header: int = 0
    header_words: int = 5
    extra: int = 0

    def states(self, count: int) -> NDArray[np.int32]:
        """The frames of a table of `count` states: all of them, or all but a closing repeat of the first."""
        if len(self.frames) not in (count, count + 1):
            raise AxoStepError(
                f"the file holds {len(self.frames)} frames; a table of {count} states needs {count}, or {count + 1} "
                "with a closing repeat of the first"
            )
        return self.frames[:count]

    def drift(self, count: int) -> float | None:
        """Ratio of the closing repeat to the first frame, summed over the image; None without a repeat."""
        if len(self.frames) != count + 1:
            return None
        return float(self.frames[-1].sum(dtype=float) / self.frames[0].sum(dtype=float))


def read_rmmd(path: Path) -> RawFrames:
    """Read raw frames. Raises AxoStepError if the length of the file fits neither known header."""
    raw = _words(path)
    if raw.size < 5:
        raise AxoStepError(f"{path} has {4 * raw.size} bytes, less than any header; it is no .rmmd file")
    ints = raw.view(">i4")
    count, rows, columns = (int(v) for v in ints[1:4])
    pixels = count * rows * columns
    header_words = raw.size - pixels
    if min(count, rows, columns) < 1 or header_words not in (4, 5):
        raise AxoStepError(
            f"{path}: the header says {count} frames of {rows} x {columns}, which is {pixels} words and a header of 4 "
            f"or 5; the file has {raw.size} words. It is truncated, or no .rmmd file."
        )
    frames = ints[header_words:].reshape(count, rows, columns)[:, ::-1].astype(np.int32)
    return RawFrames(frames, int(ints[0]), header_words, int(ints[4]) if header_words == 5 else 0)


@dataclass(frozen=True)
class MuellerFile:
    """A .cmmi or .bmmi file.

    Attributes
    ----------
    mueller : (4, 4, rows, columns) float32, not normalized, top row first.
    reduced : (K, rows, columns) float32, AxoStep's own reduced parameters; K = 0 in a .bmmi file.
    metadata : number by name of `METADATA`, without the date; as many as the file holds.
    date : of the measurement; None if the file holds none.
    trailer : words after the known metadata, as they were.
    header_words : 4 as in the format sheet, 5 as the lab's reader expects; in the latter, `header` is word 0.
    """

    mueller: NDArray[np.float32]
    reduced: NDArray[np.float32]
    metadata: dict[str, float] = field(default_factory=dict)
    date: datetime | None = None
    trailer: bytes = b""
    header_words: int = 5
    header: float = 0.0


def read_mueller_file(path: Path) -> MuellerFile:
    """Read a .cmmi file, or a .bmmi file (by its ending: no reduced parameters).

    Raises AxoStepError: neither header fits, or the file ends too early.
    """
    raw = _words(path)
    floats = raw.view(">f4")
    header_words = _mueller_header(path, floats)
    wide, high = int(floats[header_words - 4]), int(floats[header_words - 3])
    pixels, at = wide * high, header_words
    mueller = floats[at : at + 16 * pixels].reshape(pixels, 16)
    at += 16 * pixels
    reduced = np.empty((pixels, 0), dtype=">f4")
    if path.suffix.lower() != ".bmmi" and at < raw.size:
        count = float(floats[at])
        if not (count.is_integer() and 0 <= count <= 1000) or raw.size < at + 1 + count * pixels:
            raise AxoStepError(
                f"{path}: the word after the Mueller image should be the number of reduced parameters and says "
                f"{count:g}; {raw.size - at - 1} words follow. It is truncated, or a .bmmi file under another name."
            )
        reduced = floats[at + 1 : at + 1 + int(count) * pixels].reshape(pixels, int(count))
        at += 1 + int(count) * pixels
    metadata, date, trailer = _metadata(raw[at:].tobytes())
    return MuellerFile(
        _as_image(mueller, wide, high).reshape(4, 4, high, wide),
        _as_image(reduced, wide, high),
        metadata,
        date,
        trailer,
        header_words,
        float(floats[0]) if header_words == 5 else 0.0,
    )


def write_mueller_file(path: Path, image: MuellerFile) -> None:
    """Write a .cmmi file, or a .bmmi file (by its ending: the reduced parameters stay out)."""
    high, wide = image.mueller.shape[-2:]
    header = ([image.header] if image.header_words == 5 else []) + [wide, high, 4, 4]
    parts = [np.array(header, dtype=">f4").tobytes(), _as_file(image.mueller.reshape(16, high, wide))]
    if path.suffix.lower() != ".bmmi":
        parts += [struct.pack(">f", len(image.reduced)), _as_file(image.reduced)]
    path.write_bytes(b"".join(parts) + _metadata_bytes(image))


def _words(path: Path) -> NDArray[np.uint32]:
    require_file(path, AxoStepError)
    data = path.read_bytes()
    if len(data) % 4:
        raise AxoStepError(f"{path} has {len(data)} bytes, no whole number of 32-bit words; it is truncated")
    return np.frombuffer(data, dtype=np.uint32)


def _mueller_header(path: Path, floats: NDArray[np.floating]) -> int:
    for words in (4, 5):
        if floats.size >= words:
            wide, high, rows, columns = (float(v) for v in floats[words - 4 : words])
            is_size = wide.is_integer() and high.is_integer() and wide > 0 and high > 0
            if (rows, columns) == (4, 4) and is_size and floats.size >= words + 16 * wide * high:
                return words
    start = ", ".join(f"{float(v):g}" for v in floats[:5])
    raise AxoStepError(
        f"{path}: expected N1, N2, 4, 4 and 16 N1 N2 words, with or without one word before; the file has "
        f"{floats.size} words and starts with {start}. It is truncated, or no Mueller image of AxoStep."
    )


def _as_image(values: NDArray[np.floating], wide: int, high: int) -> NDArray[np.float32]:
    # The file runs up the columns, from the left: image[row, column] = file(p = column, q = high - 1 - row).
    planes = values.reshape(wide, high, -1)[:, ::-1]
    return np.ascontiguousarray(np.transpose(planes, (2, 1, 0)), dtype=np.float32)


def _as_file(planes: NDArray[np.float32]) -> bytes:
    return np.ascontiguousarray(np.transpose(planes[:, ::-1], (2, 1, 0)), dtype=">f4").tobytes()


def _metadata(data: bytes) -> tuple[dict[str, float], datetime | None, bytes]:
    metadata: dict[str, float] = {}
    date: datetime | None = None
    at = 0
    for name in METADATA:
        size = 8 if name == "date" else 4
        if at + size > len(data):
            break
        (value,) = struct.unpack_from(">d" if name == "date" else ">f", data, at)
        at += size
        if name != "date":
            metadata[name] = value
        elif np.isfinite(value) and 0 < value < 1e11:
            date = EPOCH + timedelta(seconds=value)
    return metadata, date, data[at:]


def _metadata_bytes(image: MuellerFile) -> bytes:
    data = b""
    for name in METADATA:
        if name == "date":
            seconds = (image.date - EPOCH).total_seconds() if image.date else 0.0
            data += struct.pack(">d", seconds)
        else:
            data += struct.pack(">f", image.metadata.get(name, 0.0))
    return data + image.trailer
