"""Do the sharp edges that the fit left out move as far as the inside of the image says?

What is smooth tells a shift only by its slope, and light that is added, or a spot whose brightness changes, has slopes
too: a weak second image at a distance r changes a slope as a shift by its share of r would. At an edge an image that
moves changes much, a spot nothing, and a second image changes what is beside the edge instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.features import inside
from processing.diagnosis.instrument.photon_noise import about_mean
from processing.diagnosis.instrument.pixel_sums import Pixels
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.range_of import range_of
from processing.diagnosis.search.rules import FEWEST_PIXELS, LIMIT
from processing.diagnosis.search.space import Space


@dataclass(frozen=True)
class AtEdges:
    """Fit of some shifts to the edges, all of them at once.

    Attributes
    ----------
    share, error : (S,) how much of each shift they show: one where they move as the values say, half of that where the
        image is sharper than its pixels resolve, zero where they do not move. The error is infinite where none tell.
    explained : part of what is left at the edges beyond noise that moves so; one where nothing is left.
    """

    share: Array
    error: Array
    explained: float


def at_edges(problem: InstrumentProblem, space: Space, values: Array, shifts: Sequence[Sequence[Candidate]]) -> AtEdges:
    """Fit of the shifts of given candidates to the edges of all captures, at the values (K,) of a space."""
    n = len(shifts)
    curvature, along, square, count, noise = np.zeros((n, n)), np.zeros(n), 0.0, 0, 0.0
    for k in range(len(problem.still)):
        edge = _of_capture(problem, k, space, values, shifts=shifts)
        if edge is not None:
            changes, residual, expected = edge
            curvature += changes @ changes.T
            along += changes @ residual
            square, count, noise = square + float(residual @ residual), count + residual.size, noise + expected
    share, error = np.zeros(n), np.full(n, np.inf)
    is_covered = np.diag(curvature) > 0
    if is_covered.any():
        inverse = np.linalg.pinv(curvature[np.ix_(is_covered, is_covered)], hermitian=True)
        share[is_covered] = inverse @ along[is_covered]
        # What else an edge does (interpolation fails there) is no noise, but no shift either.
        unit = max(1.0, (square - along @ share) / count)
        error[is_covered] = np.sqrt(unit * np.diag(inverse))
    beyond = square - noise
    clear = beyond > LIMIT * np.sqrt(2 * max(noise, 1.0))
    return AtEdges(share, error, float(along @ share) / beyond if clear else 1.0)


def _of_capture(
    problem: InstrumentProblem, k: int, space: Space, values: Array, *, shifts: Sequence[Sequence[Candidate]]
) -> tuple[Array, Array, float] | None:
    """Residual (S, P) of each shift at the edges of a capture, the present residual (P,), and the square of noise.

    All in units of the noise.
    """
    data, moments = problem.still[k], problem.moments[k]
    if data.steep is None:
        return None
    edge = data.steep & inside(*data.steep.shape) & ~data.clipped
    if edge.sum() < FEWEST_PIXELS:
        return None
    acting = [[c for c in group if c.acts(k, data.wavelength_nm)] for group in shifts]
    without = _values_without(space, values, [c for group in acting for c in group])
    changes = problem.changes(k, space, without)
    rest_px = about_mean(changes.shift_px) / data.pitch
    rows, sigma, use = data.values_per_pixel, moments.sigma.astype(np.float32)[:, None, None], moments.counts
    images = data.moved_back(rest_px + problem.own_px[k]).signal.reshape(rows, *edge.shape) / sigma
    q = range_of(problem.columns(k, changes) * use[:, None]).astype(np.float32)
    fitted = (q @ (q.T @ images.reshape(rows, -1))).reshape(images.shape)
    pixels = Pixels(data)
    scale, free = np.sqrt(pixels.scale[edge]), 1 - np.sum(q * q, axis=1)
    noise = 0.0
    for n in map(int, np.flatnonzero(use)):
        noise += float(free[n] * np.sum(pixels.variance_of(n)[edge] / (sigma[n] * scale) ** 2))
    leftover = np.zeros((len(shifts), int(use.sum()) * int(edge.sum())))
    for s, group in enumerate(acting):
        if not group:
            continue
        own_values = _values_without(space, values, [c for each in acting if each is not group for c in each])
        own_px = about_mean(problem.changes(k, space, own_values).shift_px) / data.pitch - rest_px
        frames = (fitted * sigma).reshape(data.signal.shape)
        moved = replace(data, signal=frames, true_variance=None).moved_back(-own_px).signal
        change = moved.reshape(images.shape)[:, edge] / sigma[:, :, 0] - fitted[:, edge]
        change -= q @ (q.T @ change)
        leftover[s] = (change / scale)[use].reshape(-1)
    return leftover, ((images - fitted)[:, edge] / scale)[use].reshape(-1), noise


def _values_without(space: Space, values: Array, candidates: Sequence[Candidate]) -> Array:
    """The values with those of some candidates at zero."""
    reduced = values.copy()
    for candidate, part in space.pairs:
        if candidate in candidates:
            reduced[part] = 0.0
    return reduced
