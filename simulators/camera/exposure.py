"""Settings of a simulated camera for an exposure, and the counts that it sends of those of its pixel source."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.pixel_formats import PixelFormat


@dataclass(frozen=True, slots=True)
class ExposureInfo:
    """Settings of the camera for one exposure.

    Attributes
    ----------
    exposure_s, gain_db, black_level :
        As the driver set them; `black_level` in counts. `gain_db` holds GainRaw on the "aravis" description.
    frame_id : 1 to 65535, then again 1.
    width, height, offset_x, offset_y, binning, decimation : region in pixels as they are sent, after binning and
        decimation.
    reverse_x, reverse_y : mirrored before the region is cut out.
    """

    exposure_s: float
    gain_db: float
    black_level: float
    frame_id: int
    width: int
    height: int
    offset_x: int
    offset_y: int
    binning: int
    decimation: int = 1
    reverse_x: bool = False
    reverse_y: bool = False

    @property
    def region(self) -> tuple[int, int, int, int]:
        """Left, top, width and height."""
        return self.offset_x, self.offset_y, self.width, self.height

    def region_of(self, sensor: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """The transmitted part of the counts of the whole sensor; binned pixels are averaged, also behind a mosaic."""
        b, d = self.binning, self.decimation
        rows, columns = (size // b * b for size in sensor.shape)
        blocks = sensor[:rows, :columns].reshape(rows // b, b, columns // b, b)
        pixels = blocks.mean(axis=(1, 3)).round().astype(np.uint16) if b > 1 else sensor
        pixels = pixels[::d, ::d][:: -1 if self.reverse_y else 1, :: -1 if self.reverse_x else 1]
        cut = pixels[self.offset_y : self.offset_y + self.height, self.offset_x : self.offset_x + self.width]
        return np.ascontiguousarray(cut)


#: Called at the start of each exposure; gives counts, uint16 of shape (height, width) of the info.
PixelSource = Callable[[ExposureInfo], NDArray[np.uint16]]


def counts_of(source: PixelSource, info: ExposureInfo, fmt: PixelFormat, bits: int) -> NDArray[np.uint16]:
    """Counts that a pixel source of so many bits gives for an exposure, cut to the bits of a format.

    A format that sends each super-pixel as one pixel has its region in super-pixels; the source is asked for pixels.
    Raises ValueError: the source gave another shape or type, or counts of more bits.
    """
    left, top, width, height = (fmt.scale * edge for edge in info.region)
    pixels = source(replace(info, width=width, height=height, offset_x=left, offset_y=top))
    if pixels.shape != (height, width) or pixels.dtype != np.uint16:
        raise ValueError(f"the pixel source gave {pixels.dtype} {pixels.shape}, not uint16 {(height, width)}")
    if bits < fmt.bits and int(pixels.max()) >> bits:
        raise ValueError(f"the pixel source gave {int(pixels.max())}, more than {bits} bits hold")
    return pixels >> np.uint16(bits - fmt.bits) if fmt.bits < bits else pixels
