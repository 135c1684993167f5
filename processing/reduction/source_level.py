"""The level of the source in each state, where two or more channels see one source.

A factor that all channels of a state have in common is no property of the sample. The levels s of the states are fitted
together with the Mueller matrices of all pixels, intensity = s_n W_n . vec(M), by least squares over the levels alone
(variable projection: Kaufman, BIT 15, 49, 1975). What the channels do not determine of them (light that hardly
polarizes) is held by their own scatter, a normal prior whose width has the highest likelihood (empirical Bayes).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.instrument.model import InstrumentModel
from processing.reduction.counts_to_signal import BlockReader
from processing.reduction.solvers.inversion import Inversion
from processing.storage.captures.capture import Capture

#: [pixels] From which the levels are found: they are common to all, so these are plenty.
MOST_PIXELS = 1 << 16
#: [parts] Of the image that these come from.
PARTS = 8
#: [steps] Of the fit of the levels, and the relative change that ends it.
STEPS, SETTLED = 30, 1e-9
#: [1] Widths of the prior that are tried: none, to a source that is not stable at all.
SPREADS = np.concatenate([[0.0], np.logspace(-5, 0.5, 111)])
#: [of the largest] Curvature below which nothing is determined of the levels.
UNSEEN = 1e-10
#: [of a pixel's variance] What the levels' errors add below this is left away: of large images, all of it.
SMALL = 1e-3


@dataclass(frozen=True)
class SourceLevels:
    """Levels of the source.

    Attributes
    ----------
    relative : (N,) level of each state over their mean.
    covariance : (N, N) of them.
    spread : standard deviation of the levels of this source.
    fitted : numbers that were fitted, for all pixels together; pixels : how many these are.
    directions : (N, D) independent errors of the levels over themselves, of one standard deviation each.
    """

    relative: Array
    covariance: Array
    spread: float
    fitted: float
    pixels: int
    directions: Array

    @property
    def stderr(self) -> Array:
        """(N,) standard errors of `relative`."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def spent(self) -> float:
        """Numbers fitted for each pixel."""
        return self.fitted / self.pixels

    def add_errors(self, planes: dict[str, NDArray[Any]], inversion: Inversion) -> None:
        """Add what the errors of the levels, common to all pixels, do to the elements (16, pixels) of each."""
        if not self.directions.size:
            return
        channels = len(inversion.w) // len(self.directions)
        variance = planes["mueller_errors"].astype(float) ** 2
        row, column = np.tril_indices(len(variance))
        for step in self.directions.T:
            moved = (inversion.pinv * np.repeat(step, channels)) @ inversion.w @ planes["mueller"]
            variance += moved**2
            if "mueller_covariance" in planes:
                planes["mueller_covariance"] += moved[row] * moved[column]
        planes["mueller_errors"] = np.sqrt(variance).astype(np.float32)

    @property
    def text(self) -> str:
        """In words, for the facts of a product."""
        return (
            f"its level in each of {self.relative.size} states is projected out (standard deviation "
            f"{100 * float(np.std(self.relative)):.2g} %); m00 belongs to the mean level"
        )


@dataclass(frozen=True)
class SourceMoments:
    """Sums over pixels that tell the levels for any measurement matrix.

    Attributes
    ----------
    products : (L, L) sums of products of intensities, each pixel weighted with the inverse of its mean signal.
    """

    products: Array
    pixels: int
    channels: int

    @classmethod
    def read(cls, reader: BlockReader, middle: bool) -> "SourceMoments | None":
        """Of the pixels of a capture that are sound in all states; None where there are none.

        `middle` : of the middle of the image alone, where W is the same all over it.
        """
        channels = reader.capture.channels
        rows = len(reader.states) * channels
        products, pixels = np.zeros((rows, rows)), 0
        for part in _parts(reader.capture, middle):
            frames = reader.read(part)
            flags, signal = np.zeros(frames.shape[2], np.uint8), np.empty(frames.shape, np.float32)
            reader.load(frames, 0, frames.shape[2], signal, mask=flags)
            y = signal.reshape(rows, -1)[:, flags == 0].astype(float)
            mean = y.mean(axis=0)
            y = y[:, mean > 0] / np.sqrt(mean[mean > 0])
            products += y @ y.T
            pixels += y.shape[1]
        return cls(products, pixels, channels) if pixels else None

    def levels(self, w: Array, basis: Array) -> SourceLevels | None:
        """Levels for W (L, 16) of which `basis` (16, R) is determined; None without degrees of freedom for them."""
        determined = w @ basis
        rows, unknowns = determined.shape
        states = rows // self.channels
        state = np.repeat(np.arange(states), self.channels)
        free = self.pixels * (rows - unknowns)
        if free <= states:
            return None
        level, fitted, spread, covariance = np.ones(states), 0.0, 0.0, np.zeros((states, states))
        rounding = float(np.finfo(float).eps * np.trace(self.products))
        for _ in range(STEPS):
            a = level[state, None] * determined
            back = np.linalg.pinv(a)
            outside = np.eye(rows) - a @ back
            residual = outside @ self.products
            # Data without noise leave only the rounding of these sums, which may be below zero.
            unit = max(float(np.trace(residual)), rounding) / (free - fitted)
            curvature = _by_state(outside * (determined @ (back @ self.products @ back.T) @ determined.T), states)
            gradient = -np.diag(residual @ back.T @ determined.T).reshape(states, -1).sum(axis=1)
            size, vector = np.linalg.eigh(curvature)
            vector, size = vector[:, size > UNSEEN * size[-1]], size[size > UNSEEN * size[-1]]
            # A common factor of all levels is M's: what is left of it in the numbers goes to the mean.
            flat = vector.T @ (level - 1) - vector.T @ gradient / size
            spread = _likeliest_spread(flat, unit / size)
            share = spread**2 / (spread**2 + unit / size)
            new = 1 + vector @ (share * flat)
            new /= new.mean()
            fitted, covariance = float(share.sum()), (vector * (share * unit / size)) @ vector.T
            moved, level = float(np.abs(new - level).max()), new
            if moved < SETTLED:
                break
        a = level[state, None] * determined
        back = np.linalg.pinv(a)
        # Directions of the levels that turn M, without those that a pixel's own noise hides.
        size, vector = np.linalg.eigh(covariance)
        steps = vector * np.sqrt(np.maximum(size, 0.0)) / level[:, None]
        light = np.linalg.eigh(back @ self.products @ back.T / self.pixels)
        typical = light.eigenvectors[:, -1] * np.sqrt(max(light.eigenvalues[-1], 0.0))
        turned = np.einsum("kl,ld,l->kd", back, steps[state], a @ typical)
        noise = unit * np.sum(back**2, axis=1)
        keep = np.max(turned**2 / noise[:, None], axis=0) > SMALL / states
        return SourceLevels(level, covariance, spread, fitted, self.pixels, steps[:, keep])


@dataclass(frozen=True)
class LeveledSource:
    """Moments that determine the levels of a source; None for one channel or one state."""

    moments: SourceMoments | None
    basis: Array

    @classmethod
    def of(cls, reader: BlockReader, model: InstrumentModel, basis: Array, varies: bool) -> "LeveledSource":
        """`varies` : the measurement matrix varies over the image, and that of its middle is asked about."""
        apart = model.projects_source and len(reader.states) > 1
        return cls(SourceMoments.read(reader, varies) if apart else None, basis)

    def leveled(self, w: Array) -> tuple[Array, SourceLevels | None]:
        """Measurement matrix (N, channels, 16) with the levels that it makes likeliest in its rows; and these."""
        levels = None if self.moments is None else self.moments.levels(w.reshape(-1, 16), self.basis)
        return (w, None) if levels is None else (w * levels.relative[:, None, None], levels)


def _parts(capture: Capture, middle: bool) -> list[slice]:
    """Row blocks spread over the image, or over the middle of it."""
    blocks = list(capture.row_blocks(MOST_PIXELS // PARTS))
    if middle:
        blocks = blocks[len(blocks) // 3 : -(len(blocks) // 3) or None]
    return [blocks[k] for k in np.unique(np.linspace(0, len(blocks) - 1, PARTS).astype(int))]


def _by_state(products: Array, states: int) -> Array:
    """(N, N) sums of products (L, L) over the channels."""
    channels = len(products) // states
    return np.asarray(products.reshape(states, channels, states, channels).sum(axis=(1, 3)))


def _likeliest_spread(levels: Array, variance: Array) -> float:
    """Standard deviation of levels found (K,), each with an error of its own variance (K,)."""
    total = variance + SPREADS[:, None] ** 2
    return float(SPREADS[np.argmin(np.sum(np.log(total) + levels**2 / total, axis=1))])
