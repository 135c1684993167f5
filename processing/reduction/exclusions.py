"""States, struck intensities and bad pixels that a diagnosis excludes: they do not measure the sample."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from processing.doors import read_json
from processing.errors import ProcessError
from processing.storage.captures.capture import Capture, CaptureError


class _Entry(BaseModel):
    """Exclusions of one capture in `diagnose --json`; the first pixel stands for a square of `pitch` pixels."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    capture: str
    states: tuple[int, ...] = ()
    hits: tuple[tuple[int, int, int, int], ...] = ()
    pixels: tuple[tuple[int, int], ...] = ()
    pitch: int = 1


@dataclass(frozen=True)
class Exclusions:
    """Parts of a capture that a reduction excludes.

    Attributes
    ----------
    states : numbers among the states of the sample.
    hits : (H, 4) state among those of the sample, channel, row, column.
    bad : (rows, columns) bad pixels; None for none.
    """

    states: tuple[int, ...] = ()
    hits: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 4), dtype=np.int64))
    bad: NDArray[np.bool_] | None = None

    @classmethod
    def read(cls, path: Path, capture: Capture) -> "Exclusions":
        """From a result of `diagnose --json`; empty if it lists no exclusion of this capture.

        Raises ProcessError: no result of `diagnose`, or of a capture of another size.
        """
        result: Any = read_json(path)
        try:
            entries = [_Entry.model_validate(entry) for entry in result["left_out"]]
        except (KeyError, TypeError, ValidationError) as error:
            raise ProcessError(f"{path} is no result of `diagnose --json` that tells what was left out.") from error
        own_entries = [entry for entry in entries if entry.capture == capture.name]
        if not own_entries:
            return cls()
        (entry,) = own_entries
        height, width = capture.frame_shape
        # Of a capture that is read super-pixel by super-pixel one pixel is as many of the sensor.
        mosaic = capture.header.mosaic
        side = len(mosaic) if mosaic is not None and capture.channels > 1 else 1
        hits = np.array(entry.hits, dtype=np.int64).reshape(-1, 4)
        pixels = np.array(entry.pixels, dtype=np.int64).reshape(-1, 2)
        hits[:, 2:] //= side
        hits = _squares(hits, entry.pitch // side, height, width)
        pixels = _squares(pixels // side, entry.pitch // side, height, width)
        bad = np.zeros((height, width), dtype=bool)
        bad[pixels[:, 0], pixels[:, 1]] = True
        return cls(entry.states, hits, bad if bad.any() else None)

    def rest_of(self, states: NDArray[np.int64], path: Path) -> NDArray[np.int64]:
        """The numbers (N,) of the states of the sample that are not excluded.

        Raises CaptureError: a state that is left out, or struck, is not among them.
        """
        if not set(self.states) | set(self.hits[:, 0].tolist()) <= set(range(len(states))):
            raise CaptureError(f"{path} has {len(states)} states; some that are to be left out are not among them.")
        return np.delete(states, self.states)

    def bad_or_struck(self, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """(rows, columns) pixels that are bad, or were struck in some state; None for none."""
        lost = np.zeros(shape, dtype=bool) if self.bad is None else self.bad.copy()
        lost[self.hits[:, 2], self.hits[:, 3]] = True
        return lost if lost.any() else None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about whole states; the mask shows the pixels."""
        numbers = ", ".join(map(str, self.states))
        return (f"left out, because the others do not predict them: state(s) {numbers}",) if self.states else ()


def _squares(first: NDArray[np.int64], pitch: int, height: int, width: int) -> NDArray[np.int64]:
    """The pixels of squares whose first pixel is in the last two columns of `first`, inside the frame."""
    offsets = np.argwhere(np.ones((pitch, pitch)))
    every = np.repeat(first, len(offsets), axis=0)
    every[:, -2:] += np.tile(offsets, (len(first), 1))
    if np.any(first < 0) or pitch < 1 or np.any(first[:, -2] >= height) or np.any(first[:, -1] >= width):
        raise ProcessError("the result of `diagnose` tells of pixels that this capture's frames do not have.")
    return np.asarray(every[(every[:, -2] < height) & (every[:, -1] < width)])
