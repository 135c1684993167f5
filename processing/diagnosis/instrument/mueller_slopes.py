"""How the values of the candidates move the Mueller matrices that the counts give."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.range_of import RANK
from processing.diagnosis.search.space import Space
from processing.instrument.changes import Changes

#: [elements, fixed] Of M/m00 that can be wrong.
ELEMENTS = 15


def mueller_slopes(
    problem: InstrumentProblem, space: Space, values: Array, left: Array | None = None
) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Of each capture: the J values that act on it, and products (16, J, J) of the slopes of each element of M/m00.

    A common factor of M is left out. Products are means over the elements, and over the pixels by their brightness.
    `left` (captures,) is what the intensities of each are known to, in units of noise (default: 1). What they do not
    tell of M, within the size of its elements, is not made wrong by an instrument either.
    """
    left = np.ones(len(problem.captures)) if left is None else left
    problem, values = problem.near(space, values)
    for k, moments in enumerate(problem.moments):
        acting = space.acting(k, problem.wavelengths_nm[k])
        mine, own = acting.space, acting.of(values)
        products, light = np.zeros((16, acting.index.size, acting.index.size)), 0.0
        changes = problem.changes(k, mine, own)
        columns = partial(_all_columns, problem, k)
        w, c = columns(changes), problem.coefficients(k, changes)
        u, size, vt = _decomposed(w * moments.counts[:, None])
        dw, dc = problem.slopes(k, mine, own, w, columns), problem.slopes_of_counts(k, mine, own, c)
        scale = 1 / moments.sigma[:, None]
        for block in moments.blocks[:: problem.folds if moments.tiles is None else 1]:
            y = np.einsum("fl,flr->lr", c, block.z) * scale
            m00 = (vt[:, 0] / size) @ (u.T @ y)
            # The best linear estimate of elements that are as large as m00 at most.
            unknown = left[k] ** 2 * block.pixels / max(float(m00 @ m00), 1e-300)
            back = (vt.T * (size / (size**2 + unknown))) @ u.T
            m = back @ y
            if problem.has_free_level(k):
                # A reduction projects the level of each state out: a common factor of its channels moves no element.
                u1, size1, vt1 = _decomposed(_without_levels(w * moments.counts[:, None], m, problem.channels(k)))
                back = (vt1.T * (size1 / (size1**2 + unknown))) @ u1.T
            slopes = -np.einsum("el,klm,mr->ker", back, dw, m, optimize=True)
            for j in np.flatnonzero(np.any(dc, axis=(1, 2))):
                slopes[j] += back @ (np.einsum("fl,flr->lr", dc[j], block.z) * scale)
            bright = float(m[0] @ m[0])
            slopes -= (slopes[:, 0] @ m[0] / max(bright, 1e-300))[:, None, None] * m
            for element, of_all in enumerate(np.moveaxis(slopes, 1, 0)):
                products[element] += acting.spread_products(of_all @ of_all.T)
            light += bright
        yield acting.index, products / (max(light, 1e-300) * ELEMENTS)


def _decomposed(w: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of rows (L, 16), of what they determine."""
    u, size, vt = np.linalg.svd(w, full_matrices=False)
    keep = size > RANK * size[0]
    return u[:, keep], size[keep], vt[keep]


def _without_levels(w: Array, m: Array, channels: int) -> Array:
    """Rows (L, 16) without what a factor of each state does to the signal of Mueller matrices m (16, R)."""
    signal = (w @ np.linalg.svd(m, full_matrices=False)[0][:, 0]).reshape(-1, channels, 1)
    rows = w.reshape(*signal.shape[:2], -1)
    common = np.sum(signal * rows, axis=1, keepdims=True) / np.maximum(np.sum(signal**2, axis=1, keepdims=True), 1e-300)
    return np.asarray((rows - signal * common).reshape(w.shape))


def _all_columns(problem: InstrumentProblem, k: int, changes: Changes) -> Array:
    """Rows (L, 16) of the measurement matrix in units of their noise, whatever the sample."""
    data = problem.captures[k]
    w = problem.models[k].rows(data.conditions.angles_deg, changes).reshape(-1, 16) * data.row_exposure[:, None]
    return np.asarray(w / problem.moments[k].sigma[:, None])
