"""Images that move, and light that reaches pixels where it does not belong."""

from typing import Literal

import numpy as np
from pydantic import Field

from processing.arrays import Image
from simulators.bench.effects.base import BenchEffect, Shot


class ImageDriftFault(BenchEffect):
    """The image moves: steadily with time, and in a circle with an axis whose element is a wedge (pixels)."""

    kind: Literal["image_drift"] = "image_drift"
    rows_per_hour: float = Field(default=0.0, description="drift downwards, pixels an hour")
    columns_per_hour: float = Field(default=0.0, description="drift to the right, pixels an hour")
    axis: str | None = Field(default=None, description="axis whose element is a wedge")
    wedge_pixels: float = Field(
        default=0.0, description="radius of the circle in which the wedge moves the image, pixels"
    )

    def optics(self, electrons: Image, shot: Shot) -> Image:
        from scipy.ndimage import shift

        hours = shot.time_s / 3600
        rows, columns = self.rows_per_hour * hours, self.columns_per_hour * hours
        if self.axis is not None:
            turn = np.deg2rad(shot.angles_deg[self.axis])
            rows, columns = rows + self.wedge_pixels * np.sin(turn), columns + self.wedge_pixels * np.cos(turn)
        if rows == 0 and columns == 0:
            return electrons
        return np.asarray(shift(electrons, (rows, columns), order=1, mode="nearest"), dtype=np.float32)


class StrayLightFault(BenchEffect):
    """Light that never saw the polarization optics: electrons a second on every pixel, falling over the columns."""

    kind: Literal["stray_light"] = "stray_light"
    e_per_s: float = Field(default=0.0, description="electrons a second")
    gradient: float = Field(default=0.0, description="relative change from the first column to the last")

    def optics(self, electrons: Image, shot: Shot) -> Image:
        ramp = 1 + self.gradient * np.linspace(-0.5, 0.5, electrons.shape[-1], dtype=np.float32)
        return np.asarray(electrons + self.e_per_s * shot.light * shot.exposure_s * ramp, dtype=np.float32)


class VeilingGlare(BenchEffect):
    """A fraction of the light of the whole image spreads evenly over it."""

    kind: Literal["veiling_glare"] = "veiling_glare"
    fraction: float = Field(default=0.0, description="part of the light")

    def optics(self, electrons: Image, shot: Shot) -> Image:
        mean = float(electrons.mean(dtype=np.float64))
        return np.asarray((1 - self.fraction) * electrons + self.fraction * mean, dtype=np.float32)


class MosaicCrosstalk(BenchEffect):
    """A fraction of each pixel's light is collected by its four neighbours, which on a mosaic look elsewhere."""

    kind: Literal["mosaic_crosstalk"] = "mosaic_crosstalk"
    fraction: float = Field(default=0.0, description="part of the light")

    def optics(self, electrons: Image, shot: Shot) -> Image:
        padded = np.pad(electrons, 1, mode="edge")
        neighbours = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        return np.asarray((1 - self.fraction) * electrons + self.fraction / 4 * neighbours, dtype=np.float32)
