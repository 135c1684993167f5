"""The error of rounding that all pixels of a frame share, where neither noise nor the image spreads their counts.

Source: Widrow and Kollar, Quantization Noise, Cambridge 2008, chapter 4. The mean of rounded numbers differs from that
of the numbers unless their spread is above about half a step.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from processing.arrays import Array
from processing.diagnosis.search.rules import ENOUGH_PX
from processing.reduction.black import Black
from processing.reduction.noise import QUANTIZATION, NoiseModel
from processing.storage.captures.capture import Capture

#: Frames (channels, rows, columns) of a stored one.
Planes: TypeAlias = Callable[[NDArray[Any]], NDArray[Any]]

#: [counts] Standard deviation of a frame from which on the mean of rounded counts is that of the intensities.
SPREADING = 1.0
#: [counts] From the middle, beyond which a pixel is hot or was hit.
NEAR = 4
#: [counts] Least spread that is tried.
LEAST = 0.03
#: [1] Levels within a count, and spreads, that are tried.
LEVELS, SPREADS = 200, 40
#: [1] Of the error of rounding, as far as the counts of an image are not normal.
NOT_NORMAL = 0.2


def rounded_off(counts: NDArray[np.float32], noise: float, *, image: bool = True) -> tuple[float, float, float]:
    """Effect of rounding on the counts of a frame.

    The intensities before rounding are taken as normal. The share of pixels with each whole count gives their mean and
    spread. If all pixels have one count, the mean is known to within a part of a count only.

    Parameters
    ----------
    counts : (P,) whole numbers, one a pixel.
    noise : least standard deviation of the intensities, counts.
    image : whether the counts are of an image, which is not normal.

    Returns
    -------
    shift : counts to add to the mean of the frame; variance : of that, counts^2.
    variance_ratio : variance of a pixel, over the `noise`^2 + 1/12 of an independent error of rounding.
    """
    middle = np.round(np.median(counts)) if counts.size else 0.0
    near = counts[np.abs(counts - middle) < NEAR]
    if not near.size or noise >= SPREADING or near.std(dtype=float) >= SPREADING:
        return 0.0, 0.0, 1.0
    steps = np.arange(-NEAR, NEAR + 1)
    number = np.bincount((near - middle).astype(int) + NEAR, minlength=steps.size)
    spread = np.geomspace(max(noise, LEAST), SPREADING, SPREADS)[:, None, None]
    level = np.linspace(-1.0, 1.0, 2 * LEVELS + 1)[:, None]
    share = ndtr((steps + 0.5 - level) / spread) - ndtr((steps - 0.5 - level) / spread)
    likelihood = np.log(np.maximum(share, 1e-300)) @ number
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    # Of counts that are not normal the mean is kept: only what rounding does to a normal one of their spread is added.
    of_mean = share @ steps
    shift_of_level = level[:, 0] - of_mean
    shift = float(np.sum(weight * shift_of_level))
    variance = float(np.sum(weight * (shift_of_level - shift) ** 2))
    of_counts = share @ steps**2 - of_mean**2
    # The spread of the image is no noise.
    of_pixel = float(np.sum(weight * np.maximum(of_counts - spread[..., 0] ** 2 + noise**2, LEAST**2)))
    return shift, variance + (NOT_NORMAL * shift * image) ** 2, of_pixel / (noise**2 + QUANTIZATION)


class Rounding:
    """Change of the mean of each frame above black by the rounding of a capture's counts.

    Attributes
    ----------
    of_black : (D, 4, channels), for each exposure of dark frames: mean counts, shift, variance and variance ratio.
    """

    def __init__(self, capture: Capture, planes: Planes, black: Black) -> None:
        detector, self._planes = capture.header.detector, planes
        self._noise = NoiseModel.of(detector, integer=True) or NoiseModel(0.0, 0.0, QUANTIZATION, "not known")
        self._applies, self._black = capture.integer_counts, black
        self._exposure_s = capture.column("exposure_s").astype(float)
        self._repeats = np.maximum(capture.column("repeats").astype(float), 1)
        self.of_black = np.tile([[0.0], [0.0], [0.0], [1.0]], (len(black.exposure_s), 1, capture.channels))
        if self._applies and black.measured:
            dark = capture.states_with("dark")
            near = np.argmin(np.abs(np.nan_to_num(self._exposure_s[dark, None] - black.exposure_s)), axis=1)
            self.of_black = np.stack([self._of_darks(capture, dark[near == k]) for k in range(len(black.exposure_s))])

    def of_frame(self, k: int, frame: NDArray[np.float32]) -> tuple[Array, Array, Array]:
        """Shift, variance and variance ratio, (channels,) each, of the stored frame of state k above black."""
        black = np.tensordot(self._black.weights(self._exposure_s[k])[0], self.of_black, axes=1)
        _, shift, variance, ratio = self._of(_subsample(self._planes(frame)), black[0], self._repeats[k])
        return shift - black[1], variance + black[2], ratio

    def _of_darks(self, capture: Capture, states: NDArray[np.int64]) -> Array:
        frames = [_subsample(self._planes(capture.frames(int(k)).astype(np.float32))) for k in states]
        return self._of(np.concatenate(frames, axis=1), np.inf, self._repeats[states].mean(), image=False)

    def _of(self, counts: NDArray[np.float32], black: Array | float, repeats: float, *, image: bool = True) -> Array:
        """Mean of the counts (channels, pixels), and `rounded_off`, (4, channels)."""
        finite = [of_channel[np.isfinite(of_channel)] for of_channel in counts]
        mean = np.array([of_channel.mean(dtype=float) if of_channel.size else 0.0 for of_channel in finite])
        if not self._applies:
            return np.stack([mean, 0 * mean, 0 * mean, 0 * mean + 1])
        sd = np.sqrt((self._noise.read + self._noise.slope * np.maximum(mean - black, 0.0)) / repeats)
        each = [rounded_off(of_channel, float(of), image=image) for of_channel, of in zip(finite, sd, strict=True)]
        return np.stack([mean, *np.transpose(each)])


def _subsample(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Counts (channels, pixels) of frames (channels, rows, columns), of a large one every so many pixels."""
    counts = planes.reshape(len(planes), -1)
    return counts[:, :: counts.shape[1] // ENOUGH_PX + 1]
