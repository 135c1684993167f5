"""The black of every exposure: dark states of that exposure, or offset plus dark current through those of others.

A dark state's mean belongs to its own exposure. Where darks of an exposure are missing and there are two or more
others, black(t) = offset + dark current x t is fitted to them, pixel by pixel (least squares, weighted by their
numbers); its error is propagated. With one other exposure only, its mean is taken as it is, and a warning says so.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from processing.arrays import Array
from processing.instrument.changes import MAD_TO_SIGMA
from processing.reduction.noise import NoiseModel
from processing.storage.captures.capture import Capture

#: Exposures closer than this part of themselves are one exposure: cameras set them in steps.
SAME_EXPOSURE = 1e-3
#: A dark current below half a count over the exposures concerned hides in the rounding.
UNSEEN_COUNTS = 0.5
#: Share of counts of zero among the darks from which on they are taken as cut off.
MOST_CUT_OFF = 0.01
#: Excess of the darks' noise over the noise model that is believed, in standard errors.
BELIEVED = 3.0


@dataclass(frozen=True)
class Black:
    """Black by exposure; with D exposures of dark states.

    Attributes
    ----------
    means : (D, channels, rows, columns) float32, counts; mean of the darks of each exposure. (1, 1, 1, 1) for a
        level that is only declared.
    exposure_s : (D,) ascending; NaN where exposures are not known.
    states, frames : (D,) dark states and frames (states times repeats) of each exposure; 0 for a declared level.
    scatter : (D,) variance of the dark states about their mean, counts^2, and its standard error; NaN for one state.
    cut_off : (D,) counts that were taken off `means`, because noise that is cut off at zero makes them too high.
    """

    means: NDArray[np.float32]
    exposure_s: Array
    states: Array
    frames: Array
    scatter: Array
    scatter_stderr: Array
    cut_off: Array = field(default_factory=lambda: np.zeros(1))

    @classmethod
    def level(cls, counts: float) -> "Black":
        """A black level without dark states."""
        none, unknown = np.zeros(1), np.full(1, np.nan)
        return cls(np.full((1, 1, 1, 1), counts, np.float32), unknown, none, none, unknown, unknown)

    @classmethod
    def of(cls, capture: Capture) -> "Black | None":
        """From the dark states of a capture; None without any."""
        dark = capture.states_with("dark")
        if dark.size == 0:
            return None
        exposure = capture.column("exposure_s")[dark].astype(float)
        repeats = np.maximum(capture.column("repeats")[dark].astype(float), 1)
        means, groups = [], []
        for group in _groups(exposure):
            mean, scatter, stderr, zero_share = _mean_of(capture, dark[group])
            cut_off = _cut_off(float(np.nanmean(mean)), zero_share) if capture.integer_counts else 0.0
            means.append(mean - np.float32(cut_off))
            groups.append([exposure[group].mean(), len(group), repeats[group].sum(), scatter, stderr, cut_off])
        return cls(np.stack(means), *np.array(groups, dtype=float).T)

    @property
    def measured(self) -> bool:
        """Whether there are dark states, not just a declared level."""
        return bool(self.states.any())

    def matches(self, exposure_s: ArrayLike) -> NDArray[np.bool_]:
        """Whether there are darks of each exposure (N,); where exposures are not known, one black serves all."""
        exposure = np.atleast_1d(np.asarray(exposure_s, dtype=float))
        if np.isnan(self.exposure_s).any():
            return np.ones(len(exposure), dtype=bool)
        near = np.abs(exposure[:, None] - self.exposure_s) <= SAME_EXPOSURE * self.exposure_s
        return np.asarray(near.any(axis=1) | np.isnan(exposure))

    def weights(self, exposure_s: ArrayLike) -> Array:
        """Black of each exposure (N,) as a weighted sum of `means`: (N, D)."""
        exposure = np.atleast_1d(np.asarray(exposure_s, dtype=float))
        if len(self.exposure_s) == 1:
            return np.ones((len(exposure), 1))
        number = self.frames / self.frames.sum()
        weights = np.broadcast_to(number, (len(exposure), len(number))).copy()
        is_known = ~np.isnan(exposure)
        line = np.stack([np.ones_like(self.exposure_s), self.exposure_s], axis=1)
        fit = np.linalg.solve((line.T * number) @ line, line.T * number)
        weights[is_known] = np.stack([np.ones(is_known.sum()), exposure[is_known]], axis=1) @ fit
        near = np.abs(exposure[:, None] - self.exposure_s)
        exact = is_known & self.matches(exposure)
        weights[exact] = np.eye(len(number))[np.argmin(near[exact], axis=1)]
        return weights

    def at(self, exposure_s: float) -> NDArray[np.float32]:
        """Black (channels, rows, columns) of one exposure; (1, 1, 1) for a declared level."""
        return np.asarray(np.tensordot(self.weights(exposure_s)[0], self.means, axes=1), dtype=np.float32)

    def mean_variance(self, noise: NoiseModel | None) -> Array:
        """Variance (D,), counts^2, of each of `means`; 0 for a declared level.

        Without a noise model from the scatter of the dark states. One alone has that of its neighbouring pixels, which
        also contains a fixed pattern of the sensor.
        """
        if not self.measured:
            return np.zeros(len(self.exposure_s))
        if noise is None:
            return self._variance_of_means
        repeats = self.frames / self.states
        return noise.averaged_floor(repeats, self._excess(noise)) / self.states

    @property
    def _variance_of_means(self) -> Array:
        return np.where(self.states > 1, self.scatter / self.states, _neighbour_variance(self.means))

    @property
    def frame_variance(self) -> float:
        """Variance of a single dark frame, counts^2, from the dark states; 0 for a declared level."""
        return float(np.mean(self._variance_of_means * self.frames)) if self.measured else 0.0

    def excess(self, noise: NoiseModel | None, exposure_s: ArrayLike) -> Array:
        """Variance of a frame without light in excess of `noise`, counts^2, at each exposure (N,).

        That is the shot noise of the dark current. It is taken from the scatter of the dark states, which needs no
        black level; 0 where it is within its error.
        """
        if noise is None:
            return np.zeros(len(np.atleast_1d(np.asarray(exposure_s))))
        return np.maximum(self.weights(exposure_s) @ self._excess(noise), 0.0)

    def _excess(self, noise: NoiseModel) -> Array:
        repeats = np.maximum(self.frames, 1) / np.maximum(self.states, 1)
        over = self.scatter - noise.averaged_floor(repeats)
        with np.errstate(invalid="ignore"):
            return np.where(over > BELIEVED * self.scatter_stderr, over * repeats, 0.0)

    def in_words(self, exposure_s: ArrayLike) -> str:
        """Description of the black that is subtracted from states of these exposures."""
        if not self.measured:
            level = float(self.means.ravel()[0])
            return f"black level {level:g} counts from the header" if level else "no black was subtracted"
        light = np.unique(np.asarray(exposure_s, dtype=float))
        matched = self.matches(light)
        total = f"{self.frames.sum():g} dark frame(s)"
        if len(self.exposure_s) == 1:
            return f"mean of {total}"
        matched_text = f"mean of the dark frames of each exposure ({_each(self.exposure_s, self.frames)})"
        if matched.all():
            return matched_text
        line = f"offset + dark current x exposure, fitted to {total} at {_seconds(self.exposure_s)}"
        if not matched.any():
            return line
        return f"{matched_text}; at {_seconds(light[~matched])}: {line}"

    def warnings(self, exposure_s: ArrayLike) -> list[str]:
        """Warnings about exposures (N,) without their own darks, and about darks that are cut off at zero."""
        return self._without_own_darks(exposure_s) + [
            f"the counts of the dark states are cut off at zero, which makes their mean too high. {counts:.2g} counts "
            "were taken off, as for normal noise. Raise the black level of the camera."
            for counts in self.cut_off[self.cut_off != 0]
        ]

    def _without_own_darks(self, exposure_s: ArrayLike) -> list[str]:
        light = np.unique(np.asarray(exposure_s, dtype=float))
        unmatched = light[~self.matches(light)]
        if not self.measured or unmatched.size == 0:
            return []
        if len(self.exposure_s) == 1:
            dark_s = float(self.exposure_s[0])
            return [
                f"the dark states were exposed {dark_s:g} s, other states differ from that by up to "
                f"{np.max(np.abs(unmatched - dark_s)):g} s: their dark current is not taken out. "
                "Take darks at the exposures of the sample."
            ]
        low, high = float(self.exposure_s[0]), float(self.exposure_s[-1])
        beyond = unmatched[(unmatched < low * (1 - SAME_EXPOSURE)) | (unmatched > high * (1 + SAME_EXPOSURE))]
        current = float(np.abs(self.means[-1].mean() - self.means[0].mean()) / (high - low))
        reach = max(low - beyond.min(initial=low), beyond.max(initial=high) - high)
        if current * reach < UNSEEN_COUNTS:
            return []
        return [
            f"the black of {_seconds(beyond)} is extrapolated from darks of {low:g} to {high:g} s, by "
            f"{current * reach:.2g} counts of dark current. Take darks at the exposures of the sample."
        ]


def _groups(exposure: Array) -> list[NDArray[np.int64]]:
    """Positions of equal exposures, ascending; all in one group where some are not known."""
    if np.isnan(exposure).any():
        return [np.arange(len(exposure))]
    order = np.argsort(exposure, kind="stable")
    steps = np.diff(exposure[order]) > SAME_EXPOSURE * exposure[order][:-1]
    return np.split(order, np.flatnonzero(steps) + 1)


def _mean_of(capture: Capture, states: NDArray[np.int64]) -> tuple[NDArray[np.float32], float, float, float]:
    """Mean frame of dark states, variance of a state about it (counts^2), its standard error, and share of zeros."""
    n, zeros = len(states), 0.0
    mean = np.zeros((capture.channels, *capture.frame_shape))
    for k in states:
        frames = capture.frames(int(k))
        mean += frames
        zeros += float(np.mean(frames <= 0)) / n
    mean /= n
    if n == 1:
        return mean.astype(np.float32), float("nan"), float("nan"), zeros
    each = []
    for k in states:
        # In blocks of rows: the whole image in floating numbers would be the largest thing in memory.
        sums = np.zeros(3)
        for rows in capture.row_blocks():
            residual = (capture.frames(int(k), rows) - mean[:, rows]).ravel()
            residual = residual[np.isfinite(residual)]
            sums += [residual.size, residual.sum(), residual @ residual]
        # A black level that moves as a whole is not noise of the pixels.
        each.append((sums[2] - sums[1] ** 2 / sums[0]) / sums[0] if sums[0] else float("nan"))
    scatter = float(np.mean(each)) * n / (n - 1)
    return mean.astype(np.float32), scatter, scatter * float(np.sqrt(2 / ((n - 1) * mean.size))), zeros


def _cut_off(mean: float, zero_share: float) -> float:
    """Counts by which the mean of normal noise is too high, as values below one half are counts of zero.

    The share of zeros and the mean give both numbers of the censored normal distribution (Tobin, Econometrica 26, 24,
    1958). Of counts of zero and one alone they do not, and the mean is taken as it is.
    """
    rest = 1 - zero_share
    if zero_share <= MOST_CUT_OFF or mean < (1 + MOST_CUT_OFF) * rest:
        return 0.0
    deviate, counts = -ndtri(zero_share), np.arange(1 + int(mean / rest) * 50)

    def excess(log_width: float) -> float:
        # The mean of counts is the sum of the probabilities of more than 0, 1, 2, ...
        return float(ndtr(deviate - counts / np.exp(log_width)).sum() - mean)

    return mean - (0.5 + float(deviate) * float(np.exp(brentq(excess, np.log(0.1), np.log(10 * mean / rest)))))


def _neighbour_variance(images: NDArray[np.float32]) -> Array:
    """Variance (D,) of a pixel of images (D, channels, rows, columns) by the median difference of neighbours.

    They are two columns apart, because the next pixel of a mosaic looks through another filter.
    """
    apart = images[..., 2:] - images[..., :-2]
    flat = np.abs(apart).reshape(len(images), -1).astype(float)
    return np.square(MAD_TO_SIGMA * np.nanmedian(flat, axis=1)) / 2 if flat.size else np.zeros(len(images))


def _seconds(exposure_s: Array) -> str:
    shown = ", ".join(f"{value:g}" for value in exposure_s[:6])
    return shown + (" ..." if len(exposure_s) > 6 else "") + " s"


def _each(exposure_s: Array, frames: Array) -> str:
    shown = ", ".join(f"{n:g} at {t:g} s" for t, n in zip(exposure_s[:6], frames[:6], strict=True))
    return shown + (" ..." if len(exposure_s) > 6 else "")
