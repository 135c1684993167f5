"""Details of a pixel or a region: intensities with the fitted curve, Mueller matrix and its decompositions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.maps.extrapolation import ExtrapolatedImage
from processing.maps.quantities import quantities_block
from processing.reduction.counts_to_signal import saturation
from processing.reduction.instrument_of_capture import choose_model
from processing.reduction.mueller_reduction import MuellerReduction
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage

#: Most intensities that a region may have, states x pixels.
MOST = 1 << 26


@dataclass(frozen=True)
class Region:
    """Rows and columns of an image; one of each is a pixel."""

    rows: slice
    columns: slice

    @classmethod
    def parse(cls, query: Any, shape: tuple[int, int]) -> "Region":
        """The region of a request, inside the image. Raises ProcessError where its numbers are none."""
        try:
            x0, y0 = int(query["x0"]), int(query["y0"])
            x1, y1 = int(query.get("x1", x0 + 1)), int(query.get("y1", y0 + 1))
        except (KeyError, ValueError) as error:
            raise ProcessError("a probe needs x0 and y0, and x1 and y1 for a region, in pixels") from error
        if not (0 <= x0 < x1 <= shape[1] and 0 <= y0 < y1 <= shape[0]):
            raise ProcessError(f"columns {x0} to {x1}, rows {y0} to {y1} do not lie in {shape[1]} x {shape[0]} pixels")
        return cls(slice(y0, y1), slice(x0, x1))

    def enlarged(self, times: int) -> "Region":
        """The same place in an image of so many times as many rows and columns."""
        return Region(*(slice(times * part.start, times * part.stop) for part in (self.rows, self.columns)))

    def reduced(self, times: int) -> "Region":
        """The cells of so many rows and columns that it touches, as a region of an image of one pixel a cell."""
        return Region(*(slice(part.start // times, -(-part.stop // times)) for part in (self.rows, self.columns)))

    @property
    def pixels(self) -> int:
        """How many."""
        return int((self.rows.stop - self.rows.start) * (self.columns.stop - self.columns.start))

    def __str__(self) -> str:
        if self.pixels == 1:
            return f"column {self.columns.start}, row {self.rows.start}"
        return (
            f"columns {self.columns.start} to {self.columns.stop - 1}, rows {self.rows.start} to {self.rows.stop - 1} "
            f"({self.pixels} pixels)"
        )


def raw_curve(capture: Capture, region: Region, channel: int) -> dict[str, Any]:
    """Counts of every state done, mean over the region, as stored: nothing but the file is needed."""
    if region.pixels * len(capture.done) > MOST:
        raise ProcessError(f"{region} x {len(capture.done)} states are more than are read at once; draw a smaller one")
    counts = [capture.frames(k, region.rows)[channel][:, region.columns] for k in range(len(capture.done))]
    top = saturation(capture)
    return {
        "where": str(region),
        "state": capture.done.tolist(),
        "role": list(capture.role),
        "counts": finite([c.mean() for c in counts]),
        "spread": finite([c.std() for c in counts]) if region.pixels > 1 else None,
        "saturated": [bool(top is not None and c.max() >= top) for c in counts],
    }


class PixelReducer:
    """Reduces single pixels and regions of a Mueller capture as `process reduce` does; opened once, asked often.

    Behind elements that turn, each super-pixel of a polarization camera is a pixel with a channel for each analyzer.

    Parameters
    ----------
    instrument : file to use instead of the model in the capture.
    """

    def __init__(self, path: Path, instrument: Path | None = None) -> None:
        self._path = path
        with self._open() as capture:
            #: Rows and columns of the frame to one of the image.
            self._cell = capture.stored_shape[0] // capture.frame_shape[0]
            self.channels = capture.channel_names
            self.reduction = MuellerReduction.of(capture, choose_model(capture, instrument))

    def _open(self) -> Capture:
        return Capture(self._path, by_super_pixel=True)

    def image(self, region: Region) -> tuple[MuellerImage, NDArray[np.float64]]:
        """A region of the frame as an image of one pixel, and its intensities (N,) in counts.

        It is the mean of those pixels that can be used; super-pixels count that the region touches. Raises
        ProcessError: none of its pixels can be used, or it is too large.
        """
        region = region.reduced(self._cell)
        if region.pixels * self.reduction.w.size // 16 > MOST:
            raise ProcessError(f"{region} is more than is reduced at once; draw a smaller one")
        with self._open() as capture:
            try:
                return self.reduction.region(capture, region.rows, region.columns)
            except ProcessError as error:
                raise ProcessError(f"{region}: {error}") from error

    def describe(self, region: Region) -> str:
        """How a region is reduced, in a few words."""
        model = self.reduction.model
        effects = f", {len(model.effects)} effect(s)" if model.effects else ""
        cells = f"; {region.reduced(self._cell).enlarged(self._cell)}" if self._cell > 1 else ""
        return f"{model.name}{effects}{cells}; black: {self.reduction.correction.source}"


def analyzer_names(channels: Sequence[str]) -> list[str]:
    """Names of channels as a plot shows them: azimuths with their unit."""
    return [f"{name}°" if name.isdecimal() else name for name in channels]


def curve(reducer: PixelReducer, region: Region) -> dict[str, Any]:
    """Signal of each sample state and channel with the fitted one, and the residual in units of the noise.

    Raises ProcessError: see `PixelReducer.image`.
    """
    image, intensities = reducer.image(region)
    channels = len(reducer.channels)
    fitted = image.w @ image.values.reshape(16).astype(float)
    noise = np.sqrt(image.intensity_variance.reshape(-1).astype(float))
    residual = (intensities - fitted) / noise
    degrees_of_freedom = max(len(fitted) - int(image.facts["rank"]), 1)
    return {
        "states": np.repeat(reducer.reduction.states, channels).tolist(),
        "series": analyzer_names(reducer.channels) if channels > 1 else [""],
        "signal": intensities.tolist(),
        "fitted": fitted.tolist(),
        "noise": finite(noise),
        "residual": finite(residual),
        "chi_square": finite(np.sum(residual**2) / degrees_of_freedom),
        "noise_known": bool(np.isfinite(image.noise_slope).all()),
        "told": reducer.describe(region),
    }


def matrix(image: MuellerImage | ExtrapolatedImage) -> dict[str, Any]:
    """Mueller matrix over m00 with its standard errors, and its decompositions."""
    measured = (image.is_determined if isinstance(image, MuellerImage) else np.ones(16, dtype=bool)).reshape(4, 4)
    m, errors = (np.where(measured, v.reshape(4, 4), np.nan).astype(float) for v in (image.values, image.errors))
    derived = quantities_block(image, (), {}) if measured.all() else {}
    values_of = {name: values.reshape(-1).astype(float) for name, values in derived.items()}
    with np.errstate(divide="ignore", invalid="ignore"):
        normalized = m / m[0, 0]
        # First order, with the covariance of an element and m00.
        errors_over_m00 = np.empty((4, 4))
        for i in range(4):
            for j in range(4):
                gradient = np.zeros((1, 1, 16))
                gradient[..., 4 * i + j] += 1 / m[0, 0]
                gradient[..., 0] -= m[i, j] / m[0, 0] ** 2
                errors_over_m00[i, j] = math.sqrt(max(float(image.variance_of(gradient).reshape(-1)[0]), 0.0))
    quantities = {
        name: {"value": finite(values), "error": finite(values_of[f"{name}_errors"])}
        for name, values in values_of.items()
        if f"{name}_errors" in values_of and values.size <= 4
    }
    return {
        "mueller": finite(normalized),
        "mueller_errors": finite(errors_over_m00),
        "m00": finite(m[0, 0]),
        "m00_error": finite(errors[0, 0]),
        "quantities": quantities,
    }


def finite(values: Any) -> Any:
    """Plain numbers for JSON; None for values that are not finite."""
    array = np.asarray(values, dtype=float)
    if array.ndim == 0:
        return float(array) if np.isfinite(array) else None
    return [finite(v) for v in array]
