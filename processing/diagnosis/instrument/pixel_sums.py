"""Sums over the pixels of a capture: second moments of their weighted features, and what noise gives of them.

The image is taken in strips, so that memory does not grow with it, and strips are spread over the cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.computing.threads import for_ranges
from processing.diagnosis.captures.capture_data import STRIP_ROWS, CaptureData
from processing.diagnosis.instrument.features import (
    FEATURES,
    derivatives_of_part,
    feature_noise,
    features,
    inside,
    shared_noise,
)
from processing.diagnosis.search.rules import ENOUGH_PX, LEAST_NOISE
from processing.instrument.changes import places

Precision = type[np.float32] | type[np.float64]
#: [pixels] Of a strip.
STRIP_PX = 16384
#: [pixels] That are multiplied together: their features stay in the cache.
TOGETHER = 2048


@dataclass(frozen=True)
class RowMeans:
    """Means (L,) over pixels of the signal, its variance, variance over scale, and the square of that.

    `inverse` : mean of 1 / scale.
    """

    signal: Array
    variance: Array
    share: Array
    share_square: Array
    inverse: float


class Pixels:
    """The intensities of a capture and their variance, each pixel weighted with the inverse of its mean variance.

    Attributes
    ----------
    u : (L, rows, columns) counts over full scale; scale : (rows, columns) mean variance of the rows.
    good : (rows, columns) pixels that count.
    """

    def __init__(self, data: CaptureData) -> None:
        channels = data.signal.shape[1]
        self.u = data.signal.reshape(-1, *data.signal.shape[2:])
        self._slope, self._floor = np.repeat(data.slope, channels), np.repeat(data.floor, channels)
        self._true = None if data.true_variance is None else data.true_variance.reshape(self.u.shape)
        alike = np.stack([shared_noise(x, y, data.shared) for x, y in data.row_moved_px])
        self.shared = alike / data.row_wide[:, None, None]
        self.scale = np.asarray(sum(self.variance_of(k) for k in range(len(self.u))) / len(self.u))
        self.good = data.usable & (self.scale > 0) & inside(*self.u.shape[1:])

    def variance_of(self, row: int) -> Array:
        """Variance (rows, columns) of one row of W."""
        return np.asarray(self.variance(slice(row, row + 1), slice(None), slice(None))[0])

    def variance(self, rows_of_w: slice, rows: slice, columns: slice) -> Array:
        """Variance of a part of `u`."""
        part = rows_of_w, rows, columns
        if self._true is not None:
            return np.asarray(self._true[part], dtype=float)
        return np.asarray(self._slope[rows_of_w, None, None] * self.u[part] + self._floor[rows_of_w, None, None])

    def means(self) -> RowMeans:
        """Means over the good pixels."""
        inverse = 1 / self.scale[self.good]
        signal, variance, share, share_square = np.zeros((4, len(self.u)))
        for k, image in enumerate(self.u):
            of_row = self.variance_of(k)[self.good]
            relative = of_row * inverse
            signal[k], variance[k] = image[self.good].mean(dtype=float), of_row.mean()
            share[k], share_square[k] = relative.mean(), np.mean(relative**2)
        return RowMeans(signal, variance, share, share_square, float(inverse.mean()))

    def precision(self, noise_floor: float) -> Precision:
        """Single precision where there are many pixels, and their noise over the mean signal is far above it."""
        return np.float32 if self.good.sum() > ENOUGH_PX and noise_floor > LEAST_NOISE else np.float64

    @cached_property
    def basis(self) -> Array:
        """Orthonormal directions (L, L) over the rows, by the light that is in each.

        In single precision the products of the bright directions would drown those of the noise, which the residual is
        made of; of features that are turned into these directions each keeps its own digits.
        """
        picked = np.flatnonzero(self.good)
        picked = picked[:: picked.size // ENOUGH_PX + 1]
        y = self.u.reshape(len(self.u), -1)[:, picked] / np.sqrt(self.scale.reshape(-1)[picked])
        return np.asarray(np.linalg.eigh(y @ y.T)[1])

    def strips(self) -> list[slice]:
        """Rows of the image that are taken together."""
        height, width = self.scale.shape
        step = max(STRIP_ROWS, -(-STRIP_PX // width))
        return [slice(first, min(first + step, height)) for first in range(0, height, step)]

    def part(self, rows: slice, columns: slice, kind: Precision) -> Part:
        """A rectangle of the image, its features to be made in this precision."""
        count = len(self.u)
        around = derivatives_of_part(self.u, rows, columns)
        return Part(
            self.u[:, rows, columns].reshape(count, -1).astype(kind),
            around.reshape(len(around), count, -1),
            self.variance(slice(None), rows, columns).reshape(count, -1),
            self.scale[rows, columns].reshape(-1),
            self.shared,
            np.stack([place[rows, columns].reshape(-1) for place in places(*self.scale.shape)]),
        )


@dataclass(frozen=True, eq=False)
class Part:
    """Pixels P of a rectangle: signal (L, P), derivatives (5, L, P), variance (L, P), its mean (P,), place (2, P)."""

    u: NDArray[Any]
    around: NDArray[np.float32]
    variance: NDArray[np.floating]
    scale: Array
    shared: Array
    place: Array

    def weighted(self, pick: NDArray[np.int64]) -> tuple[NDArray[Any], Array]:
        """Weighted features (F, L, P) of some pixels, and the noise (L, F, F) of their products."""
        plain, slopes = features(self.u[:, pick], *self.place[:, pick])
        weight = 1 / np.sqrt(self.scale[pick])
        z = np.empty((len(FEATURES), *plain.shape[1:]), dtype=plain.dtype)
        narrow = weight.astype(plain.dtype)
        np.multiply(plain, narrow, out=z[: len(plain)])
        np.multiply(self.around[:, :, pick], narrow, out=z[len(plain) :])
        share = (self.variance[:, pick] * weight**2).astype(plain.dtype)
        return z, feature_noise(slopes, share, self.shared)


def features_of_pixels(pixels: Pixels, pick: BoolArray) -> tuple[Array, Array]:
    """Weighted features (F, L, P) of a few pixels (rows, columns), and the noise (L, F, F) of their products."""
    everything = slice(0, pick.shape[1])
    parts = [
        pixels.part(strip, everything, np.float64).weighted(np.flatnonzero(pick[strip]))
        for strip in pixels.strips()
        if pick[strip].any()
    ]
    return np.concatenate([z for z, _ in parts], axis=2), np.sum([noise for _, noise in parts], axis=0)


def products_of_pixels(pixels: Pixels, picks: Sequence[BoolArray], kind: Precision) -> list[tuple[Array, Array]]:
    """Second moments (F L, F L) of the features of each pick of pixels (rows, columns), and the noise (L, F, F) there.

    `kind` is the precision that they are made in; see `Pixels.precision`.
    """
    rows = len(pixels.u)
    strips, everything = pixels.strips(), slice(0, pixels.scale.shape[1])
    # By the first strip, so that the sums do not depend on which thread was first.
    parts: dict[int, list[tuple[Array, Array]]] = {}

    def add(first: int, last: int) -> None:
        sums = [(np.zeros((len(FEATURES) * rows,) * 2), np.zeros((rows, len(FEATURES), len(FEATURES)))) for _ in picks]
        for strip in strips[first:last]:
            part = pixels.part(strip, everything, kind)
            for pick, (products, noise) in zip(picks, sums, strict=True):
                where = np.flatnonzero(pick[strip])
                for begin in range(0, where.size, TOGETHER):
                    z, of_pixels = part.weighted(where[begin : begin + TOGETHER])
                    products += _products(z, pixels)
                    noise += of_pixels
        parts[first] = sums

    for_ranges(len(strips), add, align=1, smallest=1)
    in_order = [parts[first] for first in sorted(parts)]
    totals = []
    for each in zip(*in_order, strict=True):
        products, noise = (sum(terms[1:], terms[0]) for terms in zip(*each, strict=True))
        totals.append((_turned_back(products, pixels) if kind is np.float32 else products, noise))
    return totals


def _products(z: NDArray[Any], pixels: Pixels) -> NDArray[Any]:
    if z.dtype == np.float32:
        z = pixels.basis.T.astype(np.float32) @ z
    flat = z.reshape(-1, z.shape[2])
    return np.asarray(flat @ flat.T)


def _turned_back(products: Array, pixels: Pixels) -> Array:
    """Products (F L, F L) of the rows, of those of the directions of the basis."""
    by_feature = products.reshape(-1, len(pixels.u), len(products))
    half = (pixels.basis @ by_feature).reshape(products.shape)
    return np.asarray((pixels.basis @ half.T.reshape(by_feature.shape)).reshape(products.shape))
