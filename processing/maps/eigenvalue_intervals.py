"""Intervals of the coherency eigenvalues and of what follows from them: entropy, symmetric elements.

Noise pushes equal eigenvalues apart, so that errors to first order are too small, and values far off. `intervals` says
which planes hold an interval.
"""

import numpy as np

from processing.arrays import Array, RealArray
from processing.maps.intervals import Planes, put
from processing.polarization.eigenvalue_noise import CorrectedXi0, EigenvalueNoise
from processing.polarization.magnitude import NORMAL_95, interval, positive
from processing.polarization.sorted_eigenvalues import of_gaps, of_singular_values
from processing.storage.products.images import MuellerImage

#: Parts of the light not in the dominant process between which entropy passes from that of a nearly pure sample to that
#: of a depolarizer.
PURE = (0.15, 0.45)

#: Part of the noise of a block of three that the largest of four eigenvalues leaves to the others, as noise chooses
#: it, by its true height over them in units of the noise of an element. docs/studies/error-bars.md has the program.
CHOSEN = (0.757, 0.787, 0.846, 0.9, 0.937, 0.958, 0.97, 0.981, 0.987, 0.992)
HEIGHTS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 15)


def set_eigenvalues(planes: Planes, noise: EigenvalueNoise, estimate: CorrectedXi0, components: float) -> Array:
    """Noise taken off eigenvalues, which it pushes apart, and off what follows from them.

    xi0 is that of `process xi0`. The others keep their mean; their gaps say how far noise has pushed them. Returns the
    eigenvalues (4, ...) whose deviations from that mean have lost what noise adds to their sum of squares.

    Parameters
    ----------
    components : directions that their noise has, see `sorted_eigenvalues.block_components`.
    """
    xi = planes["coherency_eigenvalues"].astype(float)
    deviation = planes["eigenvalue_deviation"].astype(float)
    observed = np.sum(deviation**2, axis=0)
    real = np.sqrt(np.maximum(1 - noise.others / observed, 0))
    unit = np.sqrt(noise.others / 8)
    spread = planes["eigenvalue_deviation_errors"] / (np.sqrt(2 / 3) * unit)
    first, second = -np.diff(xi[1:], axis=0) / unit
    three = of_gaps(first, second, spread, components)
    mean = (1 - estimate.xi0) / 3
    shrunk = np.stack([estimate.xi0, *(mean + real * deviation)])
    with_mean, without_mean = three.with_mean(estimate.stderr / (3 * unit)), three.with_mean(np.zeros_like(unit))
    deviation = deviation + unit * three.middle
    xi = mean + deviation
    low, high = xi - unit * with_mean.below, xi + unit * with_mean.above
    put(
        planes,
        "coherency_eigenvalues",
        np.stack([estimate.xi0, *xi]),
        np.stack([estimate.stderr, *(unit * with_mean.half)]),
        np.stack([estimate.interval_95[0], *low]),
        np.stack([estimate.interval_95[1], *high]),
    )
    put(
        planes,
        "eigenvalue_deviation",
        deviation,
        unit * without_mean.half,
        deviation - unit * without_mean.below,
        deviation + unit * without_mean.above,
    )
    missed = planes["td_missed"].astype(float)
    planes["td_missed_noise"] = (missed * np.sqrt(noise.others / observed)).astype(np.float32)
    # Nearly in proportion to the root of their sum of squares, the length of a vector.
    share = np.interp((4 * estimate.xi0 - 1) / (3 * unit), HEIGHTS, CHOSEN)
    total = np.square(missed) / observed * noise.others * share
    along = np.square(planes["td_missed_errors"].astype(float))
    # Where most of it is along the value, the noise has fewer directions than on average.
    square = np.fmax(total**2 / components, along**2 + np.square(np.maximum(total - along, 0)) / 7)
    put(planes, "td_missed", *interval(missed, along, total, square))
    return shrunk


def set_entropy(
    planes: Planes, xi: Array, slopes: RealArray, of_index: RealArray, *, raw: RealArray, image: MuellerImage
) -> None:
    """Entropy of eigenvalues (4, ...) whose deviations have lost what noise adds. All others are done.

    It follows the depolarization index, which has an interval where entropy is bent: near 0 and 1. What noise does at
    one index is added in squares, to first order, with each eigenvalue as large as its error at least.

    Parameters
    ----------
    slopes, of_index : (4, ..., 16) and (..., 16), gradients of the eigenvalues and of the index.
    raw : (4, ...), eigenvalues that are seen.
    """
    index, error = (planes[f"depolarization_index{end}"].astype(float) for end in ("", "_errors"))
    bounds = planes["depolarization_index_95"].astype(float)
    shares, pattern = _pattern_of(xi)
    by_eigenvalue = -np.log(np.maximum(xi, planes["coherency_eigenvalues_errors"])) / np.log(4)
    slope = np.einsum("k...,k...i->...i", by_eigenvalue, slopes)
    points, places = _ends_of_index(index, error, bounds)
    curve = _entropy_at(np.stack(points), shares, pattern)
    middle, moved = curve[0], [curve[place] for place in places]
    by_index = np.square(np.fmax(*(np.abs(each - middle) for each in curve[1:3])))
    is_cut = index > 1 - error
    if is_cut.any():
        # The curve ends at a pure sample; the covariance with the index does not.
        by_element = image.covariance_with(of_index)
        shared, variance = (np.einsum("...i,...i->...", by_element, each) for each in (slope, of_index))
        by_index = np.where(is_cut, np.fmax(by_index, np.square(shared) / variance), by_index)
    apart = np.sqrt(np.maximum(image.variance_of(slope) - by_index, 0))
    sides = [deviate * apart for deviate in (1, NORMAL_95, 1, NORMAL_95)]
    # The more the three others differ, the less is the entropy at one index; first order does not show by how much.
    deviation = raw[1:] - raw[1:].mean(axis=0)
    deviation *= planes["td_missed_95"][1] / np.abs(deviation).max(axis=0)
    other = np.concatenate([xi[:1], (1 - xi[:1]) / 3 + deviation])
    sides[1] = np.fmax(sides[1], moved[1] - _entropy_at(points[places[1]], *_pattern_of(other)))
    ends = [
        np.clip(middle + sign * np.hypot(each - middle, side), 0, 1)
        for sign, each, side in zip((-1, -1, 1, 1), moved, sides, strict=True)
    ]
    low, low_95, high, high_95 = ends
    # Next to an end of its range the estimate is not the middle of the interval: a truth there has no pull of 1.
    value = np.where((low > 0) & (high < 1), (low + high) / 2, middle)
    is_bounded = ((bounds[0] > 0) | (bounds[1] != 1)) & np.isfinite(value + low_95 + high_95)
    error = np.where(is_bounded, np.maximum(high - value, value - low), np.fmax(np.fmax(value, 1 - value), 1 / 2))
    without = np.isnan(image.errors[0, 0])
    low_95, high_95 = (np.where(is_bounded, side, end) for side, end in zip((low_95, high_95), (0.0, 1.0), strict=True))
    put(planes, "entropy", value, *(np.where(without, np.nan, part) for part in (error, low_95, high_95)))


def _ends_of_index(index: Array, error: Array, bounds: Array) -> tuple[list[Array], list[int]]:
    """Depolarization indices (...) at which entropy is needed: the index, one error to each side, and other ends.

    Also returns which of them belong to the lower end of entropy at 68 and 95 %, and to the upper one. Next to a pure
    sample an end is that of a number which is not negative. `bounds` (2, ...) are those of the index at 95 %.
    """
    points, places = [index, index - error, index + error], []
    for side, end in ((-1, 1), (1, 0)):
        units = error, np.abs(bounds[end] - index) / NORMAL_95
        for level, (far, unit) in enumerate(zip((points[1 + end], bounds[end]), units, strict=True)):
            off_pure = (1 - index) / unit
            is_near = bool((off_pure < 4).any())
            if is_near:
                nearest = np.where(off_pure < 4, 1 - positive(off_pure, level, 1 - end) * unit, far)
                far = np.fmin(nearest, far) if side > 0 else nearest
            if is_near or level:
                points.append(far)
            places.append(len(points) - 1 if is_near or level else 1 + end)
    return points, places


def _pattern_of(xi: Array) -> tuple[Array, Array]:
    """Shares (3, ...) of the light not in the dominant process, and eigenvalues (4, ...) less 1/4 at an index of 1."""
    off, shares = xi - 0.25, np.clip(xi[1:], 0, None)
    sums = shares.sum(axis=0)
    shares = np.where(sums > 0, shares / np.where(sums > 0, sums, 1), 1 / 3)
    return shares, off / np.sqrt(4 / 3 * np.square(off).sum(axis=0))


def _entropy_at(index: Array, shares: Array, pattern: Array) -> Array:
    """Entropy of depolarization indices (n, ...): of a nearly pure sample the shares (3, ...) of the other light stay.

    `pattern` (4, ...) are the eigenvalues less 1/4 at an index of 1.
    """
    even = 1 + np.square(shares).sum(axis=0)
    lost = 0.75 * (1 - np.square(np.clip(index, 0, 1)))
    lost = (1 - np.sqrt(np.maximum(1 - even * lost, 0))) / even
    share, height = np.clip((lost - PURE[0]) / (PURE[1] - PURE[0]), 0, 1), np.maximum(index, 0)
    total, sum_of_logs = np.zeros(index.shape), np.zeros(index.shape)
    for pure, off in zip((1 - lost, *(lost * each for each in shares)), pattern, strict=True):
        xi = off * height
        xi += 0.25 - pure
        xi *= share
        xi += pure
        total += np.maximum(xi, 0, out=xi)
        xi *= np.log(xi + 1e-300)
        sum_of_logs += xi
    return np.asarray((np.log(total) - sum_of_logs / total) / np.log(4))


def set_symmetric(planes: Planes, unit: Array, components: float) -> None:
    """Elements of the symmetric decomposition are sorted singular values, which noise pushes apart and away from 0.

    Parameters
    ----------
    unit : (...), noise of an element of the matrix whose singular values they are, see `symmetric.noise_of_core`. Their
        own errors are no measure of it: noise turns the singular vectors to where it is largest.
    components : directions that their noise has, see `sorted_eigenvalues.block_components`.
    """
    names = [f"symmetric_d{k}" for k in (1, 2, 3)]
    value, error = (np.stack([planes[f"{n}{end}"] for n in names]).astype(float) for end in ("", "_errors"))
    shifts = of_singular_values(value, error, unit, components)
    value = value + shifts.middle
    for k, name in enumerate(names):
        is_finite = np.isfinite(shifts.half[k])
        bounds = np.maximum(value[k] - shifts.below[k], -1.0), np.minimum(value[k] + shifts.above[k], 1.0)
        low, high = (np.where(is_finite, b, end) for b, end in zip(bounds, (-1.0, 1.0), strict=True))
        put(planes, name, value[k], shifts.half[k], low, high)
