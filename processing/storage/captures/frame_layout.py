"""Frames of one detector that hold the images of several channels: beams side by side, or cells of a mosaic."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class FrameLayout(Protocol):
    """Where the channels lie in a stored frame (rows, columns)."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names, in the order in which `split` gives the images."""

    def shape(self, stored: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of the image of one channel. Raises ValueError where the frame cannot hold them."""

    def stored_rows(self, rows: slice) -> slice:
        """Rows of the stored frame that rows of the images come from."""

    def split(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Stored frames (..., rows, columns) to images (..., channels, rows, columns)."""


@dataclass(frozen=True)
class Beams:
    """Images side by side, in equal parts of the columns, from the left: behind a Wollaston prism two of them."""

    channels: tuple[str, ...]

    def shape(self, stored: tuple[int, int]) -> tuple[int, int]:
        """All rows, and a beam's part of the columns."""
        if stored[1] % len(self.channels):
            raise ValueError(f"{stored[1]} columns cannot be cut into {len(self.channels)} beams of equal width")
        return stored[0], stored[1] // len(self.channels)

    def stored_rows(self, rows: slice) -> slice:
        """The same rows."""
        return rows

    def split(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Cut into strips."""
        height, width = self.shape(frames.shape[-2:])
        strips = frames.reshape(*frames.shape[:-2], height, len(self.channels), width)
        return np.moveaxis(strips, -2, -3)


@dataclass(frozen=True)
class Cells:
    """The pixels of a mosaic by their polarizer: each super-pixel becomes one pixel with a channel for each of its own.

    Nothing is interpolated, so no two pixels share noise; the channels look at places half a super-pixel apart.

    Attributes
    ----------
    mosaic : names over the super-pixel, row by row from the top left of the frame.
    channels : the same names in the order of the instrument's channels.
    """

    mosaic: tuple[tuple[str, ...], ...]
    channels: tuple[str, ...]

    def shape(self, stored: tuple[int, int]) -> tuple[int, int]:
        """Super-pixels down and across."""
        height, width = len(self.mosaic), len(self.mosaic[0])
        if stored[0] % height or stored[1] % width:
            raise ValueError(f"frames of {stored[0]} x {stored[1]} hold no whole super-pixels of {height} x {width}")
        return stored[0] // height, stored[1] // width

    def stored_rows(self, rows: slice) -> slice:
        """The rows of these super-pixels."""
        height = len(self.mosaic)
        return slice(rows.start * height, rows.stop * height)

    def split(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Take the pixels of each polarizer."""
        self.shape(frames.shape[-2:])
        height, width = len(self.mosaic), len(self.mosaic[0])
        place = {name: (r, c) for r, line in enumerate(self.mosaic) for c, name in enumerate(line)}
        kinds = [frames[..., r::height, c::width] for r, c in (place[name] for name in self.channels)]
        return np.stack(kinds, axis=-3)
