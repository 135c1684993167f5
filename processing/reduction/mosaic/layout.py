"""The 2 x 2 super-pixel of a polarization mosaic: which channel sits where."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, Image
from processing.errors import ProcessError

#: Elements of a packed covariance of (S0, S1, S2).
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class MosaicError(ProcessError):
    """A mosaic frame or its layout cannot be used."""


#: [degree] Analyzers of a super-pixel that has each of them once.
FOUR_DEG = (0.0, 45.0, 90.0, 135.0)


@dataclass(frozen=True)
class MosaicLayout:
    """The channels of a 2 x 2 super-pixel.

    Attributes
    ----------
    channels : names.
    offsets : row and column of each.
    azimuths_deg : of each analyzer, in steps of 45 degrees; None where they are not known.
    """

    channels: tuple[str, ...]
    offsets: tuple[tuple[int, int], ...]
    azimuths_deg: tuple[float, ...] | None = None

    @classmethod
    def of(
        cls, mosaic: Sequence[Sequence[str]], channels: Sequence[str], analyzers: Array | None = None
    ) -> "MosaicLayout":
        """From rows of channel names, e.g. (("90", "45"), ("135", "0")), and the rows (channels, 3) of their analyzers.

        Raises MosaicError: it is not 2 x 2.
        """
        where = {name: (r, c) for r, row in enumerate(mosaic) for c, name in enumerate(row)}
        if len(mosaic) != 2 or any(len(row) != 2 for row in mosaic) or set(where) != set(channels):
            raise MosaicError(f"a mosaic is 2 x 2 and names each channel once; got {mosaic} for {', '.join(channels)}")
        azimuths = None
        if analyzers is not None:
            turn = np.rad2deg(np.arctan2(analyzers[:, 2], analyzers[:, 1])) / 2
            azimuths = tuple((np.rint(turn / 45) * 45 % 180).tolist())
        return cls(tuple(channels), tuple(where[name] for name in channels), azimuths)

    def four_azimuths_deg(self) -> tuple[float, ...]:
        """Azimuths of the analyzers. Raises MosaicError unless they are 0, 45, 90 and 135 degrees."""
        if self.azimuths_deg is None or tuple(sorted(self.azimuths_deg)) != FOUR_DEG:
            raise MosaicError(
                "this method needs analyzers at 0, 45, 90 and 135 degrees; the instrument file has "
                f"{', '.join(self.channels)} nearest to {self.azimuths_deg}. Take another one with --demosaic."
            )
        return self.azimuths_deg

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
