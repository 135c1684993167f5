"""Tiles of an image, each against a matrix of its own: what an effect needs that varies over the image.

A retarder's Mueller matrix is linear in 1, cosine and sine of its retardance: its values at three retardances (nodes)
determine all others. What is quadratic in the rows has twice the frequency as well, and needs five. The derivative of a
tile's rows by a value is a weighted sum of its derivatives at the nodes. So the curvature, the sum over tiles of
tr(P dA_i S dA_j^T) with S = A+ y y^T A+^T, needs the sum of P x S over the tiles alone, once for each node. With
hundreds of values and tiles that is a fraction of the work.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, pairwise, product

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Moments, Tiles
from processing.diagnosis.instrument.pixel_sums import STRIP_PX, Part, Pixels
from processing.diagnosis.instrument.projection import Projected, add_parts
from processing.diagnosis.instrument.slopes import ChangesOf, fitted, slopes_of_rows, step_values
from processing.diagnosis.search.space import Space, Sums
from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import extra_retardance, with_extra


def tile_columns(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (tiles, L, K) where a retardance varies over the image, rows in units of their noise."""
    if moments.tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    shares = shares_of_tiles(moments.tiles, changes, 1)
    return np.asarray(np.tensordot(shares, columns_at_nodes(model, data, moments, changes), axes=(0, 0)))


def shares_of_tiles(tiles: Tiles, changes: Changes, frequencies: int) -> Array:
    """Share (n, tiles) of each tile in the rows at each node (one frequency), or in what is quadratic in them (two)."""
    return _shares(extra_retardance(changes, tiles.x, tiles.y), frequencies)


def columns_at_nodes(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (n, L, K) with every retardance that varies at one of a few values, rows in units of their noise."""
    nodes = _nodes(len(changes.field_retardance_rad), 1)
    a = np.stack([data.rows_of(model, with_extra(changes, node)) for node in nodes])
    return np.asarray(a / moments.sigma[:, None])


def at_more_nodes(linear: Array, elements: int) -> Array:
    """Linear function of the rows (..., n, L, K) at the nodes that the quadratic needs, for so many elements."""
    shares = _shares(_nodes(elements, 2).T, 1)
    flat = linear.reshape(*linear.shape[:-2], -1)
    return np.asarray(shares.T @ flat).reshape(*linear.shape[:-3], shares.shape[1], *linear.shape[-2:])


def _shares(extra: Array, frequencies: int) -> Array:
    """Shares (n, P) of the nodes at extra retardances (elements, P)."""
    apart = extra - _nodes(len(extra), frequencies)[:, :, None]
    waves = 1 + 2 * sum(np.cos(m * apart) for m in range(1, frequencies + 1))
    return np.asarray(np.prod(waves / (2 * frequencies + 1), axis=1))


def _nodes(elements: int, frequencies: int) -> Array:
    """Retardances (n, elements), all combinations of 2 frequencies + 1 equally spaced ones, radians."""
    count = 2 * frequencies + 1
    around = 2 * np.pi * np.arange(count) / count
    return np.array(list(product(around, repeat=elements))).reshape(count**elements, elements)


#: [features, fixed] The counts alone, of all features.
PLAIN = (0,)


def features_of_tiles(
    data: CaptureData, moments: Moments, tiles: Tiles, used: Sequence[int]
) -> tuple[tuple[int, ...], Array, Array]:
    """Which features, pseudo-pixels (T, F, L, R) of them in every tile, and their noise (T, L, F, F).

    Of the rows that count, in units of their noise. `used` are numbers of FEATURES in ascending order, of which the
    counts are the first; others may stand beside them.
    """
    cache, numbers = tiles.features, tuple(used)
    if numbers not in cache:
        if numbers != PLAIN:
            for key, (z, noise) in cache.items():
                if set(numbers) <= set(key):
                    return key, z, noise
            # One set of them is kept, with all that was asked for before: they are large.
            larger = [key for key in cache if key != PLAIN]
            numbers = tuple(sorted(set(numbers).union(*larger)))
            for key in larger:
                del cache[key]
        use = np.flatnonzero(moments.counts)
        z, noise = _of_counts(tiles, use) if numbers == PLAIN else _of_features(data, tiles, np.array(numbers), use)
        # In place: they are large.
        sigma = moments.sigma[use]
        z /= sigma[:, None]
        noise /= (sigma**2)[:, None, None]
        cache[numbers] = z, noise
    return numbers, *cache[numbers]


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
    for t, (part, pick) in enumerate(_pixels_of_tiles(pixels, tiles)):
        of_part, of_pixels = part.weighted(pick)
        flat = of_part[np.ix_(used, use)].reshape(size, -1)
        few = np.asarray(np.linalg.qr(flat.T, mode="r")).T if flat.shape[1] > size else flat
        z[t, :, : few.shape[1]], noise[t] = few, of_pixels[np.ix_(use, used, used)]
    return z.reshape(count, used.size, use.size, -1), noise


def _pixels_of_tiles(pixels: Pixels, tiles: Tiles) -> Iterator[tuple[Part, NDArray[np.int64]]]:
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
                inside = place[:, across.start - left : across.stop - left]
                yield part, inside[tiles.pick[down, across]]


@dataclass(frozen=True)
class TileSlopes:
    """Derivatives of a capture with tiles by K values.

    Attributes
    ----------
    at_nodes : (K, n, L, K') of the rows at each node; zero for the values that follow.
    shares : (n, tiles) what each tile has of what is linear or quadratic in them.
    fields : (J,) values whose derivative differs from tile to tile; da : (J, tiles, L, K') of the rows.
    counted : (C,) values of corrections of the counts; dc : (C, F, L) of the coefficients.
    """

    at_nodes: Array
    shares: Array
    fields: NDArray[np.int64]
    da: Array
    counted: NDArray[np.int64]
    dc: Array

    def of_rows(self, rows: NDArray[np.int64], features: NDArray[np.int64]) -> TileSlopes:
        """Slopes of some rows and some features alone."""
        dc = self.dc[:, features][..., rows]
        return replace(self, at_nodes=self.at_nodes[:, :, rows], da=self.da[:, :, rows], dc=dc)


def slopes_of_tiles(
    model: InstrumentModel,
    data: CaptureData,
    moments: Moments,
    changes_of: ChangesOf,
    *,
    space: Space,
    values: Array,
    a: Array,
    dc: Array,
) -> TileSlopes:
    """Derivatives at values (K,), where the rows are a (tiles, L, K'), with those dc (K, F, L) of the coefficients."""
    if moments.tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    changes, conditions = changes_of(values), data.conditions
    columns = partial(columns_at_nodes, model, data, moments)
    at_nodes = slopes_of_rows(
        changes_of, model, conditions, space, values=values, a=columns(changes), columns=columns, varying=False
    )
    fields = {
        part.start + j: (tile_columns(model, data, moments, changes_of(moved)) - a) / step
        for candidate, part in fitted(space)
        if candidate.effect.varies_over_image
        for j, (moved, step) in enumerate(step_values(candidate, part, values))
    }
    counted = np.flatnonzero(np.any(dc, axis=(1, 2)))
    return TileSlopes(
        at_more_nodes(at_nodes, len(changes.field_retardance_rad)),
        shares_of_tiles(moments.tiles, changes, 2),
        np.array(list(fields), dtype=np.int64),
        np.array(list(fields.values())).reshape(-1, *a.shape),
        counted,
        dc[counted],
    )


def add_slopes(parts: Iterable[tuple[NDArray[np.int64], Projected]], slopes: TileSlopes, fold: int, out: Sums) -> None:
    """Add gradient, stretch and curvature of the tiles of one fold: numbers of some tiles, and these projected.

    Projected tiles are large: of those that were seen the products of their unknowns are kept, and P.
    """
    index, of_one = np.concatenate([slopes.fields, slopes.counted]), slopes.at_nodes.shape[1:]
    of_excess, of_noise = np.zeros((2, *of_one))
    across = np.zeros((of_one[0], index.size * of_one[1] * of_one[2]))
    tiles, outside, power = [], [], []
    for some, part in parts:
        tiles.append(some)
        outside.append(part.outside)
        power.append(part.unknowns.swapaxes(1, 2) @ part.unknowns)
        shares = slopes.shares[:, some]
        for total, by_rows in zip((of_excess, of_noise), part.by_rows, strict=True):
            total += np.tensordot(shares, by_rows, axes=1)
        if index.size:
            moved = _add_own(some, part, slopes, fold, out=out)
            across += shares @ (moved @ part.unknowns).swapaxes(0, 1).reshape(len(some), -1)
    flat = slopes.at_nodes.reshape(len(slopes.at_nodes), -1)
    out.gradient[fold] += flat @ of_excess.reshape(-1)
    out.stretch[fold] += flat @ of_noise.reshape(-1)
    by_own = across.reshape(of_one[0], index.size, of_one[1] * of_one[2]).swapaxes(0, 1)
    with_own = by_own.reshape(index.size, flat.shape[1]) @ flat.T
    out.curvature[fold, index] -= with_own
    out.curvature[fold, :, index] -= with_own
    if tiles:
        shares = slopes.shares[:, np.concatenate(tiles)]
        out.curvature[fold] += _curvature(slopes.at_nodes, shares, np.concatenate(outside), np.concatenate(power))


def _add_own(some: NDArray[np.int64], part: Projected, slopes: TileSlopes, fold: int, *, out: Sums) -> Array:
    """Add what fields and counts tell by themselves; what (J + C, T, L, R) they do to the residual."""
    fields, counted = slopes.fields, slopes.counted
    da, dc, index = slopes.da[:, some], slopes.dc[:, None], np.concatenate([fields, counted])
    moved = np.zeros((index.size, *part.residual.shape))
    moved[: fields.size] = -(part.outside @ da) @ part.unknowns.swapaxes(1, 2)
    for of_one, each in zip(moved[fields.size :], dc, strict=True):
        of_one[:] = part.moved_by_counts(each)
    of_fields = da.reshape(fields.size, part.by_rows[1].size) @ part.by_rows[1].reshape(-1)
    pull = np.concatenate([of_fields, part.pull_of_counts(dc)])
    flat = moved.reshape(index.size, part.residual.size)
    out.stretch[fold, index] += pull
    out.gradient[fold, index] += flat @ part.residual.reshape(-1) - pull
    out.curvature[fold, index[:, None], index] += flat @ flat.T
    return moved


def _curvature(at_nodes: Array, shares: Array, outside: Array, power: Array) -> Array:
    """Curvature (K, K), of at_nodes (K, n, L, K'), shares (n, T), P (T, L, L) and S (T, K', K')."""
    values, nodes, rows, columns = at_nodes.shape
    # The sum comes as (column, row; row, column): the layout of the derivatives follows, as they are the smaller.
    flat, power = outside.reshape(-1, rows * rows).T, np.ascontiguousarray(power.swapaxes(0, 1))
    curvature = np.zeros((values, values))
    for node in range(nodes):
        summed = ((flat * shares[node]) @ power).reshape(columns * rows, rows * columns)
        slope = at_nodes[:, node]
        curvature += slope.swapaxes(1, 2).reshape(values, -1) @ summed @ slope.reshape(values, -1).T
    return curvature


#: [tiles] That are reckoned with together: what is made of them stays small.
TILES_TOGETHER = 32


def add_tiles(
    data: CaptureData,
    moments: Moments,
    tiles: Tiles,
    a: Array,
    *,
    c: Array,
    slopes: TileSlopes | None,
    out: Sums,
    apart: int | None = None,
) -> None:
    """Add what tiles say of a (tiles, L, K) and coefficients c (F, L), with their derivatives by each value.

    `apart` : rows of a state, where every state has unknowns of its own; None: all rows have the same unknowns.
    """
    is_used = np.any(c, axis=1) if slopes is None else np.any(c, axis=1) | np.any(slopes.dc, axis=(0, 2))
    used, use = np.flatnonzero(is_used), np.flatnonzero(moments.counts)
    columns, z, noise = features_of_tiles(data, moments, tiles, used.tolist())
    index = np.searchsorted(columns, used)
    around = used >= len(FEATURES) - DERIVATIVES

    def projected(fold: int, selection: slice) -> Iterator[tuple[NDArray[np.int64], Projected]]:
        rows = use[selection]
        scatter = noise[:, selection] if len(columns) == used.size else noise[:, selection, index[:, None], index]
        in_fold = np.flatnonzero(tiles.fold == fold)
        for some in np.split(in_fold, range(TILES_TOGETHER, in_fold.size, TILES_TOGETHER)):
            features = z[some[:, None], index, selection]
            part = Projected(features, scatter[some], a[some][:, rows], c[None, used][:, :, rows], around=around)
            add_parts(part, moments, rows[None], tiles.pixels[some], fold=tiles.fold[some], out=out)
            yield some, part

    bounds = [] if apart is None else (np.flatnonzero(np.diff(use // apart)) + 1).tolist()
    for selection in (slice(i, j) for i, j in pairwise([0, *bounds, use.size])):
        of_rows = None if slopes is None else slopes.of_rows(use[selection], used)
        for fold in range(len(out.excess)):
            if of_rows is None:
                deque(projected(fold, selection), maxlen=0)
            else:
                add_slopes(projected(fold, selection), of_rows, fold, out)
