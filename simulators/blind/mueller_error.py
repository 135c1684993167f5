"""Error of a reduced Mueller image against the truth, and whether its intervals hold it."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from processing.arrays import Array
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product
from simulators.blind.real_bench import PATCH

#: Standard errors of M / m00 times m00 that come from the instrument, where the product has them.
SYSTEMATIC = "mueller_systematic"
#: Pixels darker than this part of the brightest are not looked at, nor so many pixels next to them: what an image that
#: moves does there is no question of polarization.
FAINT, RIM = 0.1, 3
#: 95 % of a normal distribution.
INTERVAL = 1.959964


@dataclass(frozen=True)
class Coverage:
    """Share of M / m00 within the 95 % interval: of single pixels, and of means over `PATCH` x `PATCH` pixels."""

    pixels: float
    patches: float


@dataclass(frozen=True)
class Reduced:
    """M / m00 of a capture with its errors, (15, rows, columns) but m00, and where it counts (rows, columns)."""

    values: Array
    noise: Array
    systematic: Array
    lit: NDArray[np.bool_]

    @classmethod
    def of(cls, path: Path, model: InstrumentModel) -> "Reduced":
        """Reduce a capture as `process reduce` does; `model` as loaded from its file."""
        with TemporaryDirectory() as folder, Capture(path) as capture:
            product_file = Path(folder) / "mueller.h5"
            reduce_mueller(capture, model.at(capture.header.wavelength_nm), product_file, ())
            image = MuellerImage.load(product_file)
            with Product(product_file) as product:
                systematic = product.get(SYSTEMATIC) if SYSTEMATIC in product.names else np.zeros_like(image.values)
        m = image.values.reshape(16, *image.mask.shape).astype(float)
        normalized = m[1:] / m[0]
        # Gradient of m_k / m00 by the elements: 1 / m00 by m_k, -m_k / m00^2 by m00.
        c = np.moveaxis(image.covariance(), (2, 3), (0, 1))
        diagonal = np.einsum("kkrc->krc", c)[1:]
        variance = (diagonal - 2 * normalized * c[1:, 0] + normalized**2 * c[0, 0]) / m[0] ** 2
        lit = (image.mask == 0) & (m[0] > FAINT * m[0].max())
        return cls(
            normalized,
            np.sqrt(np.maximum(variance, 0)),
            systematic.reshape(16, *image.mask.shape)[1:] / m[0],
            binary_erosion(lit, iterations=RIM, border_value=0),
        )

    def error(self, truth: Array) -> float:
        """Root mean square error of M / m00; truth (4, 4, rows, columns)."""
        deviation = self.values - truth.reshape(16, *self.lit.shape)[1:]
        return float(np.sqrt(np.mean(deviation[:, self.lit] ** 2)))

    def coverage(self, truth: Array) -> Coverage:
        """How often the truth is in the interval of noise and systematic error."""
        deviation = self.values - truth.reshape(16, *self.lit.shape)[1:]
        inside = np.abs(deviation) <= INTERVAL * np.hypot(self.noise, self.systematic)
        is_full = np.asarray(_patches(self.lit).all(axis=-1))
        # Noise of pixels is independent, an error of the instrument is common to them.
        noise = np.sqrt((_patches(self.noise) ** 2).sum(axis=-1)) / PATCH**2
        sigma = np.hypot(noise, _patches(self.systematic).mean(axis=-1))
        means = np.abs(_patches(deviation).mean(axis=-1)) <= INTERVAL * sigma
        return Coverage(float(inside[:, self.lit].mean()), float(means[:, is_full].mean()))


def error_of(path: Path, model: InstrumentModel, truth: Array) -> float:
    """Error of M / m00 of a capture, reduced with a model; infinite where it can not be reduced.

    NaN for a polarization camera: its super-pixels are reduced by other means, and M is not asked of it here.
    """
    if model.mosaic is not None:
        return float("nan")
    try:
        return Reduced.of(path, model).error(truth)
    except ProcessError:
        return float("inf")


def coverage_of(path: Path, model: InstrumentModel, truth: Array) -> Coverage:
    """Coverage of M / m00 of a capture, reduced with a model; NaN where `error_of` has no number."""
    if model.mosaic is not None:
        return Coverage(float("nan"), float("nan"))
    try:
        return Reduced.of(path, model).coverage(truth)
    except ProcessError:
        return Coverage(float("nan"), float("nan"))


def _patches(values: Array | NDArray[np.bool_]) -> Array:
    """(..., patches, PATCH^2) of (..., rows, columns)."""
    lead, (rows, columns) = values.shape[:-2], (n // PATCH for n in values.shape[-2:])
    cut = values[..., : rows * PATCH, : columns * PATCH].reshape(*lead, rows, PATCH, columns, PATCH)
    return np.asarray(np.moveaxis(cut, -3, -2).reshape(*lead, rows * columns, PATCH * PATCH))
