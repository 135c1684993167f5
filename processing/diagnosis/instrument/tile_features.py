"""Pseudo-pixels of the features of every tile of an image, as far as they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.moments import Moments, Tiles
from processing.diagnosis.instrument.pixel_sums import STRIP_PX, Part, Pixels

#: [features, fixed] The counts alone, of all features.
PLAIN = (0,)


def features_of_tiles(
    data: CaptureData, moments: Moments, tiles: Tiles, used: Sequence[int]
) -> tuple[tuple[int, ...], Array, Array]:
    """Which features, pseudo-pixels (T, F, L, R) of them in every tile, and their noise (T, L, F, F).

    Of the rows that count, in units of their noise. `used` are numbers of FEATURES in ascending order, of which the
    counts are the first; others may stand beside them.
    """
    kept, asked = tiles.features, tuple(used)
    if asked not in kept:
        if asked != PLAIN:
            for known, (z, noise) in kept.items():
                if set(asked) <= set(known):
                    return known, z, noise
            # One set of them is kept, with all that was asked for before: they are large.
            larger = [known for known in kept if known != PLAIN]
            asked = tuple(sorted(set(asked).union(*larger)))
            for known in larger:
                del kept[known]
        use = np.flatnonzero(moments.counts)
        z, noise = _of_counts(tiles, use) if asked == PLAIN else _of_features(data, tiles, np.array(asked), use)
        # In place: they are large.
        sigma = moments.sigma[use]
        z /= sigma[:, None]
        noise /= (sigma**2)[:, None, None]
        kept[asked] = z, noise
    return asked, *kept[asked]


def _of_counts(tiles: Tiles, use: NDArray[np.int64]) -> tuple[Array, Array]:
    """The counts alone: as few pseudo-pixels as there are rows say the same."""
    value, vector = np.linalg.eigh(tiles.s)
    root = vector * np.sqrt(np.maximum(value, 0.0))[:, None]
    return root[:, None, use], tiles.noise[:, use, None, None]


def _of_features(
    data: CaptureData, tiles: Tiles, used: NDArray[np.int64], use: NDArray[np.int64]
) -> tuple[Array, Array]:
    """The pixels of every tile, or as many pseudo-pixels as there are products to tell where they are fewer."""
    pixels, count = Pixels(data), tiles.x.size
    size = used.size * use.size
    z = np.zeros((count, size, min(int(tiles.pixels.max()), size)))
    noise = np.zeros((count, use.size, used.size, used.size))
    for t, (part, pick) in enumerate(_parts(pixels, tiles)):
        of_part, of_pixels = part.weighted(pick)
        flat = of_part[np.ix_(used, use)].reshape(size, -1)
        few = np.asarray(np.linalg.qr(flat.T, mode="r")).T if flat.shape[1] > size else flat
        z[t, :, : few.shape[1]], noise[t] = few, of_pixels[np.ix_(use, used, used)]
    return z.reshape(count, used.size, use.size, -1), noise


def _parts(pixels: Pixels, tiles: Tiles) -> Iterator[tuple[Part, NDArray[np.int64]]]:
    """For every tile a rectangle of the image that it is in, and its pixels there that count.

    Derivatives of the image need pixels around: small tiles beside each other have one rectangle.
    """
    for _, of_row in groupby(tiles.boxes, key=lambda box: box[0].start):
        row = list(of_row)
        down, wide = row[0][0], row[0][1].stop - row[0][1].start
        together = max(1, STRIP_PX // ((down.stop - down.start) * wide))
        for boxes in (row[k : k + together] for k in range(0, len(row), together)):
            left, right = boxes[0][1].start, boxes[-1][1].stop
            part = pixels.part(down, slice(left, right), np.float64)
            place = np.arange((down.stop - down.start) * (right - left)).reshape(-1, right - left)
            for _, across in boxes:
                mine = place[:, across.start - left : across.stop - left]
                yield part, mine[tiles.pick[down, across]]
