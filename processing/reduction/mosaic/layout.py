"""The 2 x 2 super-pixel of a polarization mosaic: which channel sits where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.errors import ProcessError

#: Elements of a packed covariance of (S0, S1, S2).
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class MosaicError(ProcessError):
    """A mosaic frame or its layout cannot be used."""


@dataclass(frozen=True)
class MosaicLayout:
    """Row and column offset of each channel in the 2 x 2 super-pixel, in the order of the channels."""

    channels: tuple[str, ...]
    offsets: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, mosaic: Sequence[Sequence[str]], channels: Sequence[str]) -> MosaicLayout:
        """From rows of channel names, e.g. (("90", "45"), ("135", "0")). Raises MosaicError unless it is 2 x 2."""
        where = {name: (r, c) for r, row in enumerate(mosaic) for c, name in enumerate(row)}
        if len(mosaic) != 2 or any(len(row) != 2 for row in mosaic) or set(where) != set(channels):
            raise MosaicError(f"a mosaic is 2 x 2 and names each channel once; got {mosaic} for {', '.join(channels)}")
        return cls(tuple(channels), tuple(where[name] for name in channels))

    @property
    def azimuths_deg(self) -> tuple[float, ...]:
        """Analyzer azimuths, which the names of the channels are. Raises MosaicError for another kind of name."""
        try:
            return tuple(float(name) for name in self.channels)
        except ValueError:
            raise MosaicError(
                f"this method needs channels named by their azimuth in degrees (0, 45, 90, 135); got {self.channels}"
            ) from None

    def check(self, shape: tuple[int, int]) -> None:
        """Raise MosaicError unless a frame (rows, columns) holds whole super-pixels and at least four of them."""
        if shape[0] % 2 or shape[1] % 2 or min(shape) < 4:
            raise MosaicError(f"a mosaic frame has an even number of rows and columns, at least 4 x 4; got {shape}")

    def samples(self, frame: NDArray[np.generic], channel: int) -> NDArray[np.generic]:
        """View (rows/2, columns/2) of one channel's own pixels."""
        r, c = self.offsets[channel]
        return frame[r::2, c::2]

    def sparse(self, frame: Image, channel: int) -> Image:
        """Frame (rows, columns) with one channel's pixels and zero elsewhere."""
        out = np.zeros_like(frame)
        r, c = self.offsets[channel]
        out[r::2, c::2] = frame[r::2, c::2]
        return out
