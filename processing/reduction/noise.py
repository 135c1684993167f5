"""Noise of a linear camera: variance in counts^2 as a straight line in the signal (EMVA 1288, "linear model")."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Detector

#: Variance of rounding to whole counts, counts^2.
QUANTIZATION = 1.0 / 12.0


@dataclass(frozen=True)
class NoiseModel:
    """variance of a frame = slope * signal + floor, signal in counts above black.

    A mean of n frames that is rounded again has (slope * signal + read) / n + rounding.

    Attributes
    ----------
    slope : counts; 1 / (electrons a count), from shot noise.
    read : counts^2; read noise.
    rounding : counts^2; 1/12 for whole counts, 0 for floating numbers.
    source : where the numbers come from, for the provenance.
    stated : counts^2; whole variance of one intensity of each state that is reduced, where the data state it.
    residual_share : of each pixel's own residual in its variance; None if the noise is known without residuals.
    """

    slope: float
    read: float
    rounding: float
    source: str
    stated: tuple[float, ...] = ()
    residual_share: float | None = None

    @classmethod
    def of(cls, detector: Detector, integer: bool) -> "NoiseModel | None":
        """From the detector's constants; None if the gain is not known.

        `integer` adds the variance of rounding, which read noise in electrons does not contain.
        """
        gain = detector.gain_e_per_count
        if gain is None:
            return None
        source = f"gain {gain:g} e/count, read noise "
        source += "unknown, taken as 0" if detector.read_noise_e is None else f"{detector.read_noise_e:g} e"
        read = (detector.read_noise_e or 0.0) / gain
        return cls(1.0 / gain, read**2, QUANTIZATION if integer else 0.0, source)

    @classmethod
    def of_sigma(cls, sigma: ArrayLike) -> "NoiseModel":
        """From the standard deviation (N,) of one intensity of each state, counts: column `sigma` of the states."""
        return cls(0.0, 0.0, 0.0, "column sigma of the states", tuple(np.square(sigma).tolist()))

    @property
    def floor(self) -> float:
        """Variance without light, counts^2."""
        return self.read + self.rounding

    def averaged_floor(self, repeats: ArrayLike, excess: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Variance without light of means of `repeats` frames, counts^2; `excess` is what a frame has above `read`."""
        return np.asarray((self.read + np.asarray(excess, dtype=float)) / np.asarray(repeats, float) + self.rounding)

    def floor_of_rows(self, repeats: ArrayLike, excess: ArrayLike, channels: int) -> NDArray[np.float64]:
        """Variance without light (N channels,) of rows of W, counts^2; stated noise is all that there is."""
        if self.stated:
            return np.repeat(np.array(self.stated), channels)
        return self.averaged_floor(repeats, excess)

    def variance(self, signal: ArrayLike) -> NDArray[np.float64]:
        """Variance, counts^2, at a signal in counts above black; a negative signal has the floor's."""
        return np.asarray(self.slope * np.maximum(signal, 0.0) + self.floor)


def noise_of(capture: Capture, states: NDArray[np.int64]) -> NoiseModel | None:
    """As the states file states it for each state, else from the detector's constants; None without either."""
    if capture.sigma is not None:
        return NoiseModel.of_sigma(capture.sigma[states])
    return NoiseModel.of(capture.header.detector, integer=capture.integer_counts)
