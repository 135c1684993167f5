"""One capture as `diagnose` sees it: the signal of all states, its noise, and what is known of the sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.threads import for_ranges
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import InstrumentModel
from processing.reduction.move_image import shifted_back

#: Corrected counts of signals (N, channels, rows, columns), and their slope over the old ones.
Correct = Callable[[Array], tuple[Array, Array]]
#: [rows] Of an image that are worked on together.
STRIP_ROWS = 16


@dataclass(frozen=True)
class SharedNoise:
    """Correlation of the noise of a pixel with that of others, as the frames were stored.

    Attributes
    ----------
    right, down : part of the next pixel that was mixed into each, 0 to 0.5 (resampled or smoothed images).
    rows, columns : variance common to a row, or a column, of a frame, over that of a pixel.
    """

    right: float = 0.0
    down: float = 0.0
    rows: float = 0.0
    columns: float = 0.0

    @property
    def shown(self) -> float:
        """Variance of a pixel over that before pixels were mixed."""
        return (1 - 2 * self.right * (1 - self.right)) * (1 - 2 * self.down * (1 - self.down))


def mixed_part(covariance: float) -> float:
    """Part m of the next pixel that was mixed into each, of the covariance m (1 - m) of neighbours."""
    return float((1 - np.sqrt(1 - 4 * covariance)) / 2)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Parts of a capture that do not measure the sample and are excluded.

    Attributes
    ----------
    frames : state to the rms by which it differs from what the others predict, relative to the signal;
        exchanged : those of them that are in each other's place.
    hits : (H, 4) state, channel, row and column of single intensities; pixels : (B, 2) row and column of bad pixels.
    pitch : pixels of the sensor from one row or column of these to the next.
    """

    frames: dict[int, float] = field(default_factory=dict)
    exchanged: tuple[int, ...] = ()
    hits: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 4), dtype=np.int64))
    pixels: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    pitch: int = 1

    def __bool__(self) -> bool:
        return bool(self.frames) or len(self.hits) > 0 or len(self.pixels) > 0


@dataclass(frozen=True)
class CaptureData:
    """One capture, ready to be compared with a model.

    Attributes
    ----------
    name : identity for reports: title and file name.
    signal : (N, channels, rows, columns) float32, counts above black over full scale.
    exposure : (N,) relative; multiplies the rows of W.
    sample : (16,) known Mueller matrix up to a throughput, or None.
    slope, floor : variance of a signal u is slope[n] * u + floor[n], in units of full scale squared, each (N,).
    noise_known : False if no noise could be found (few pixels and no detector constants): then slope is 0, and
        what is left over after the fit is the only measure.
    noise_source : in words.
    clipped : (rows, columns) True where some state is at the top of the range.
    clipped_states : (N,) True for states in which some pixel is.
    noise_estimated : slope and floor describe the scatter of these very counts, not the photons and the read-out.
    noise_factors : by which slope and floor were changed from what is stated, since the images show so.
    noise_level : by which both were changed beside that.
    true_variance : (N, channels, rows, columns) where the variance is not a line in the counts any more.
    moved_px : (N, 2) by how much each frame was moved back, from what it had moved to the right and down; pixels here.
        That averages the noise of neighbours, and adds no information.
    usable : (rows, columns) True where every state has a number and the pixel is not dark.
    dark_fraction : part of the pixels that are too dark, or too close to dark ones, to be used.
    steep : (rows, columns) True where a pixel is left out because it lies at a sharp edge; None: nowhere.
    cut_off : numbers of states that do not count because their counts are cut off at zero.
    shared : what pixels have of their noise in common; slope and floor are those of wide patterns.
    wide : (N,) variance of a pattern as wide as the image over what independent pixels would give it; None: 1.
    rounding : (N,) variance that the rounding of counts gives the mean of all pixels, which no number of them averages.
    evidence : what speaks against its frames, as a camera that was frozen, in sentences.
    noise_told : what patterns of the noise are not declared, in sentences; white_told : how its variance differs, which
        holds while `noise_factors` are not one.
    left_out : frames, hits and pixels that are no measurement of the sample.
    place_px : (channels, 2) where in a super-pixel each channel looks, from its middle to the right and down; pixels
        here. None: all look at the same place.
    binned : side of the squares over which pixels were averaged.
    pitch : pixels of the sensor from one pixel here to the next.
    """

    name: str
    signal: NDArray[np.float32]
    conditions: Conditions
    exposure: Array
    sample: Array | None
    slope: Array
    floor: Array
    noise_known: bool
    noise_source: str
    clipped: NDArray[np.bool_]
    clipped_states: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    simulated: bool
    wavelength_nm: float
    binned: int = 1
    pitch: int = 1
    dark_fraction: float = 0.0
    steep: NDArray[np.bool_] | None = None
    cut_off: tuple[int, ...] = ()
    noise_estimated: bool = False
    noise_factors: tuple[float, float] = (1.0, 1.0)
    noise_level: tuple[float, float] = (1.0, 1.0)
    true_variance: NDArray[np.float32] | None = None
    moved_px: Array | None = None
    place_px: Array | None = None
    left_out: LeftOut = field(default_factory=LeftOut)
    shared: SharedNoise = field(default_factory=SharedNoise)
    wide: Array | None = None
    rounding: Array | None = None
    noise_told: tuple[str, ...] = ()
    evidence: tuple[str, ...] = ()
    white_told: str | None = None

    @property
    def told_of_noise(self) -> tuple[str, ...]:
        """Sentences about the noise where it is not what is declared."""
        if self.white_told is None or self.noise_factors == (1.0, 1.0):
            return self.noise_told
        return (*self.noise_told, self.white_told)

    @property
    def values_per_pixel(self) -> int:
        """Intensities of one pixel: states times channels."""
        return int(self.signal.shape[0] * self.signal.shape[1])

    @property
    def row_counts(self) -> NDArray[np.bool_]:
        """(values_per_pixel,) whether a row of W counts."""
        counts = np.ones(self.conditions.states, dtype=bool)
        counts[[*self.cut_off, *self.left_out.frames]] = False
        return np.repeat(counts, self.signal.shape[1])

    @property
    def row_wide(self) -> Array:
        """`wide` (values_per_pixel,) of each row of W."""
        return np.ones(self.values_per_pixel) if self.wide is None else np.repeat(self.wide, self.signal.shape[1])

    @property
    def row_moved_px(self) -> Array:
        """By how much the frame of each row of W was moved back, (values_per_pixel, 2); zero where it was not."""
        if self.moved_px is None:
            return np.zeros((self.values_per_pixel, 2))
        return self._frame_px(self.moved_px).reshape(-1, 2)

    def _frame_px(self, shift_px: Array) -> Array:
        """(N, channels, 2) by how much each frame has moved against the middle of its super-pixels."""
        place = np.zeros((self.signal.shape[1], 2)) if self.place_px is None else self.place_px
        return np.asarray(shift_px[:, None] - place)

    def matrix_of(self, model: InstrumentModel, changes: Changes | None = None) -> Array:
        """Measurement matrix W (values_per_pixel, 16), each row for the exposure of its state."""
        # Without a rotating element one row stands for all states.
        w = model.rows(self.conditions.angles_deg, changes) * self.exposure[:, None, None]
        return w.reshape(-1, 16)

    def rows_of(self, model: InstrumentModel, changes: Changes | None = None) -> Array:
        """Rows (values_per_pixel, K) that the light of a pixel reaches: all 16 columns of W, one of a known sample."""
        w = self.matrix_of(model, changes)
        return w if self.sample is None else (w @ self.sample)[:, None]

    def variance(self, where: slice | NDArray[np.bool_] = slice(None)) -> Array:
        """Variance in full scale squared of rows (N, channels, rows, columns), or of pixels (N, channels, P).

        It is right on average over noisy signals. Cutting it off at zero signal would make it too large in dark states,
        so a single one may be negative.
        """
        if self.true_variance is not None:
            return np.asarray(self.true_variance[:, :, where], dtype=float)
        signal = self.signal[:, :, where]
        slope, floor = (of_state.reshape(-1, *(1,) * (signal.ndim - 1)) for of_state in (self.slope, self.floor))
        return np.asarray(slope * signal + floor)

    def undone(self, correct: Correct) -> CaptureData:
        """The capture with corrected counts, and noise that is stretched with them."""
        signal, variance = np.empty((2, *self.signal.shape), dtype=np.float32)

        def strip(rows: slice) -> None:
            signal[:, :, rows], slope = correct(self.signal[:, :, rows].astype(float))
            # A bend weighs dark pixels by their slope: none may have a negative variance here.
            variance[:, :, rows] = slope**2 * np.maximum(self.variance(rows), self.floor.reshape(-1, 1, 1, 1) / 2)

        for_strips(signal.shape[2], strip)
        return replace(self, signal=signal, true_variance=variance)

    def moved_back(self, shift_px: Array) -> CaptureData:
        """The capture with every frame moved back by what it had moved to the right and down, (N, 2) pixels here.

        Channels that look at places apart are moved to one: so far as the image is smooth, they then see the same.
        """
        frame_px = self._frame_px(shift_px)
        return replace(
            self,
            signal=_moved_back(self.signal, frame_px),
            # What is a line in the counts stays one.
            true_variance=None if self.true_variance is None else _moved_back(self.true_variance, frame_px),
            moved_px=shift_px,
        )

    def with_noise_of(self, correct: Correct) -> CaptureData:
        """The same counts with the noise that corrected counts tell: photon noise follows the light, not the counts."""
        variance = np.empty_like(self.signal)

        def strip(rows: slice) -> None:
            variance[:, :, rows] = self.noise_of(*correct(self.signal[:, :, rows].astype(float)))

        for_strips(variance.shape[2], strip)
        return replace(self, true_variance=variance)

    def noise_of(self, signal: Array, slope: Array) -> Array:
        """Variance (N, channels, ...) of the counts by corrected ones, of the given slope over them."""
        shape = (-1, 1, 1, 1)
        return np.asarray(self.slope.reshape(shape) * np.maximum(signal, 0) / slope**2 + self.floor.reshape(shape))


def _moved_back(frames: NDArray[np.float32], frame_px: Array) -> NDArray[np.float32]:
    moved = np.empty_like(frames)
    for n, channel in np.ndindex(frames.shape[:2]):
        moved[n, channel] = shifted_back(frames[n, channel], *frame_px[n, channel])
    return moved


def for_strips(height: int, work: Callable[[slice], object]) -> None:
    """Call `work` for all rows of an image, some at a time, spread over the cores."""

    def several(first: int, last: int) -> None:
        for row in range(first, last, STRIP_ROWS):
            work(slice(row, min(row + STRIP_ROWS, last)))

    for_ranges(height, several, align=STRIP_ROWS, smallest=2 * STRIP_ROWS)
