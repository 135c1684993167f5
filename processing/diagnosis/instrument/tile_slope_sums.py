"""Gradient and curvature of what tiles say, most of it summed over the tiles before it is told apart by value.

The derivative of a tile's rows by a value is made of its derivatives at a few retardances, of which every tile has its
share. So the curvature, the sum over tiles of tr(P dA_i S dA_j^T) with S = A+ y y^T A+^T, needs the sum of P x S over
the tiles alone, once for each node. With hundreds of values and tiles that is a fraction of the work.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.projection import Projected
from processing.diagnosis.instrument.tile_slopes import TileSlopes
from processing.diagnosis.search.space import Sums


def add_slopes(parts: Iterable[tuple[NDArray[np.int64], Projected]], slopes: TileSlopes, fold: int, out: Sums) -> None:
    """Add gradient, stretch and curvature of the tiles of one fold: numbers of some tiles, and these projected.

    Projected tiles are large: of those that were seen the products of their unknowns are kept, and P.
    """
    own, of_one = np.concatenate([slopes.fields, slopes.counted]), slopes.at_nodes.shape[1:]
    of_excess, of_noise = np.zeros((2, *of_one))
    across = np.zeros((of_one[0], own.size * of_one[1] * of_one[2]))
    tiles, outside, power = [], [], []
    for some, part in parts:
        tiles.append(some)
        outside.append(part.outside)
        power.append(part.unknowns.swapaxes(1, 2) @ part.unknowns)
        shares = slopes.shares[:, some]
        for total, by_rows in zip((of_excess, of_noise), part.by_rows, strict=True):
            total += np.tensordot(shares, by_rows, axes=1)
        if own.size:
            moved = _add_own(some, part, slopes, fold, out)
            across += shares @ (moved @ part.unknowns).swapaxes(0, 1).reshape(len(some), -1)
    flat = slopes.at_nodes.reshape(len(slopes.at_nodes), -1)
    out.gradient[fold] += flat @ of_excess.reshape(-1)
    out.stretch[fold] += flat @ of_noise.reshape(-1)
    by_own = across.reshape(of_one[0], own.size, of_one[1] * of_one[2]).swapaxes(0, 1)
    with_own = by_own.reshape(own.size, flat.shape[1]) @ flat.T
    out.curvature[fold, own] -= with_own
    out.curvature[fold, :, own] -= with_own
    if tiles:
        shares = slopes.shares[:, np.concatenate(tiles)]
        out.curvature[fold] += _curvature(slopes.at_nodes, shares, np.concatenate(outside), np.concatenate(power))


def _add_own(some: NDArray[np.int64], part: Projected, slopes: TileSlopes, fold: int, out: Sums) -> Array:
    """Add what fields and counts tell by themselves; what (J + C, T, L, R) they do to the residual."""
    fields, counted = slopes.fields, slopes.counted
    da, dc, own = slopes.da[:, some], slopes.dc[:, None], np.concatenate([fields, counted])
    moved = np.zeros((own.size, *part.residual.shape))
    moved[: fields.size] = -(part.outside @ da) @ part.unknowns.swapaxes(1, 2)
    for of_one, each in zip(moved[fields.size :], dc, strict=True):
        of_one[:] = part.moved_by_counts(each)
    of_fields = da.reshape(fields.size, part.by_rows[1].size) @ part.by_rows[1].reshape(-1)
    pull = np.concatenate([of_fields, part.pull_of_counts(dc)])
    flat = moved.reshape(own.size, part.residual.size)
    out.stretch[fold, own] += pull
    out.gradient[fold, own] += flat @ part.residual.reshape(-1) - pull
    out.curvature[fold, own[:, None], own] += flat @ flat.T
    return moved


def _curvature(at_nodes: Array, shares: Array, outside: Array, power: Array) -> Array:
    """Curvature (K, K), of at_nodes (K, n, L, K'), shares (n, T), P (T, L, L) and S (T, K', K')."""
    values, nodes, rows, columns = at_nodes.shape
    # The sum comes as (column, row; row, column): the layout of the derivatives follows, as they are the smaller.
    flat, power = outside.reshape(-1, rows * rows).T, np.ascontiguousarray(power.swapaxes(0, 1))
    out = np.zeros((values, values))
    for node in range(nodes):
        summed = ((flat * shares[node]) @ power).reshape(columns * rows, rows * columns)
        slope = at_nodes[:, node]
        out += slope.swapaxes(1, 2).reshape(values, -1) @ summed @ slope.reshape(values, -1).T
    return out
