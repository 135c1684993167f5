"""Intervals of the coherency eigenvalues and of what follows from them: entropy, dominant process, symmetric elements.

Noise pushes equal eigenvalues apart, so that errors to first order are too small, and values far off. `intervals` says
which planes hold an interval.
"""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.maps.intervals import SEEN, Planes, put
from processing.polarization.eigenvalue_noise import CorrectedXi0, EigenvalueNoise
from processing.polarization.magnitude import NORMAL_95, interval, positive
from processing.polarization.quantities import entropy
from processing.polarization.sorted_eigenvalues import of_gaps

#: Equal eigenvalues are seen apart by the noise between them times the root of this, on average.
_REPELLED = 4.0
#: Parts of the light not in the dominant process between which entropy passes from that of a nearly pure sample to that
#: of a depolarizer, and errors of the depolarization index from which on its own bend is seen.
PURE, FLAT = (0.15, 0.45), 5.0
#: Largest singular value of 3 x 3 noise of variance 1: 68 % of them are smaller.
OF_NOISE = 2.8


def set_eigenvalues(planes: Planes, noise: EigenvalueNoise, found: CorrectedXi0, components: float) -> Array:
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
    own = planes["eigenvalue_deviation_errors"] / (np.sqrt(2 / 3) * unit)
    first, second = -np.diff(xi[1:], axis=0) / unit
    three = of_gaps(first, second, own, components)
    mean = (1 - found.xi0) / 3
    shrunk = np.stack([found.xi0, *(mean + real * deviation)])
    with_mean, without_mean = three.with_mean(found.stderr / (3 * unit)), three.with_mean(np.zeros_like(unit))
    deviation = deviation + unit * three.middle
    xi = mean + deviation
    low, high = xi - unit * with_mean.below, xi + unit * with_mean.above
    put(
        planes,
        "coherency_eigenvalues",
        np.stack([found.xi0, *xi]),
        np.stack([found.stderr, *(unit * with_mean.half)]),
        np.stack([found.interval_95[0], *low]),
        np.stack([found.interval_95[1], *high]),
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
    total = np.square(missed) / observed * noise.others
    along = np.square(planes["td_missed_errors"].astype(float))
    put(planes, "td_missed", *interval(missed, along, total, total**2 / components))
    return shrunk


def set_entropy(planes: Planes, xi: Array, found: CorrectedXi0) -> None:
    """Entropy of eigenvalues (4, ...) whose deviations have lost what noise adds. `set_magnitudes` is done.

    It is bent where an eigenvalue may be zero, and where all may be equal. There it follows what is known: of a nearly
    pure sample xi0, the others in proportion; of a depolarizer the depolarization index, all eigenvalues in proportion.
    """
    own = entropy_of(xi)
    spread = planes["entropy_errors"].astype(float)
    errors = np.concatenate([found.stderr[None], planes["coherency_eigenvalues_errors"][1:]])
    index, u = planes["depolarization_index"].astype(float), planes["depolarization_index_errors"].astype(float)
    bent = (xi < SEEN * errors).any(axis=0) | (index < FLAT * u) | ~np.isfinite(spread)
    rest, off = np.clip(xi[1:], 0, None), xi - 0.25
    sums = rest.sum(axis=0)
    rest = np.where(sums > 0, rest / np.where(sums > 0, sums, 1), 1 / 3)
    scale = np.sqrt(4 / 3 * np.square(off).sum(axis=0))
    share = np.clip((1 - found.xi0 - PURE[0]) / (PURE[1] - PURE[0]), 0, 1)
    both = (found.interval_68, np.stack([index - u, index + u])), (found.interval_95, planes["depolarization_index_95"])
    middle, half = planes["td_missed"].astype(float), planes["td_missed_errors"].astype(float)
    missed = np.stack([np.maximum(middle - half, 0), middle + half]), planes["td_missed_95"]
    ends = []
    for (of_xi0, of_index), deviate, level in zip(both, (1.0, NORMAL_95), (0, 1), strict=True):
        unit = (of_xi0[1] - of_xi0[0]) / (2 * deviate)
        observed = (1 - found.xi0) / unit
        lost = np.where(observed < 4, positive(observed)[level] * unit, 1 - of_xi0[::-1])
        pure = _of_pure(lost, 1 - found.xi0, rest, missed[level] / np.where(middle > 0, middle, 1))
        even = [entropy_of(0.25 + off * (np.maximum(x, 0) / scale)) for x in of_index[::-1]]
        far = [(1 - share) * p + share * e for p, e in zip(pure, even, strict=True)]
        near = [own - deviate * spread, own + deviate * spread]
        if level:
            # Beyond first order entropy depends on both.
            near = [np.fmin(near[0], far[0]), np.fmax(near[1], far[1])]
        ends += [np.where(bent, f, n) for f, n in zip(far, near, strict=True)]
    low, high, low_95, high_95 = ends
    put(planes, "entropy", (low + high) / 2, (high - low) / 2, np.maximum(low_95, 0), np.minimum(high_95, 1))


def _of_pure(lost: Array, middle: Array, rest: Array, apart: Array) -> list[Array]:
    """Ends of the entropy by those (2, ...) of what xi0 leaves, and of how far the others `rest` (3, ...) are apart."""

    def at(p: Array, spread: Array | float) -> Array:
        light = np.clip(p, 0, 0.75)
        shares = np.clip(1 / 3 + spread * (rest - 1 / 3), 0, None)
        return entropy_of(np.concatenate([1 - light[None], light * shares / shares.sum(axis=0)]))

    own = at(middle, 1.0)
    return [
        own + side * np.hypot(at(p, 1.0) - own, at(middle, spread) - own)
        for p, spread, side in zip(lost, apart[::-1], (-1, 1), strict=True)
    ]


def entropy_of(xi: Array) -> Array:
    """Entropy (...) of eigenvalues (4, ...), without negative ones."""
    physical = np.clip(xi, 0, None)
    return np.asarray(entropy(np.moveaxis(physical / physical.sum(axis=0), 0, -1)))


def set_symmetric(planes: Planes, relative: Array) -> None:
    """Elements of the symmetric decomposition are sorted: near ones mix, and noise alone makes some.

    Parameters
    ----------
    relative : (...), root mean square error of an element other than m00, over m00.
    """
    names = [f"symmetric_d{k}" for k in (1, 2, 3)]
    value = np.stack([np.ones_like(planes[names[0]]), *(planes[n] for n in names)]).astype(float)
    error = np.stack([np.zeros_like(value[0]), *(planes[f"{n}_errors"] for n in names)]).astype(float)
    near = ~(np.abs(np.diff(value, axis=0)) > SEEN * np.hypot(error[:-1], error[1:]))
    for k, name in enumerate(names):
        mixed = near[k] | near[min(k + 1, 2)] | (np.abs(value[k + 1]) < SEEN * relative)
        spread = np.hypot(error[k + 1], np.where(mixed, (OF_NOISE if k == 0 else 2) * relative, 0))
        known = np.isfinite(spread)
        bounds = value[k + 1] - NORMAL_95 * spread, value[k + 1] + NORMAL_95 * spread
        low, high = (np.where(known, b, end) for b, end in zip(bounds, (-1.0, 1.0), strict=True))
        put(planes, name, value[k + 1], spread, low, high)


def widen_dominant(planes: Planes, noise: EigenvalueNoise, uneven: float) -> Array:
    """Errors of the dominant process for the gap without noise, which pushes eigenvalues apart.

    `set_eigenvalues` is done. Returns the factor (...), NaN where the process is not determined.

    Parameters
    ----------
    uneven : noise of the noisiest directions over that of all.
    """
    xi = planes["coherency_eigenvalues"].astype(float)
    gap, coupling = xi[0] - xi[1], uneven * noise.coupling
    # Two processes whose eigenvalues were equal would be seen this far apart.
    seen = (gap + np.sqrt(gap**2 + 4 * _REPELLED * coupling**2)) / 2
    factor = np.where(gap > SEEN * coupling, seen / gap, np.nan)
    for name in [n for n in planes if n.startswith("dominant_") and not n.endswith("_errors")]:
        planes[f"{name}_errors"] = planes[f"{name}_errors"] * factor.astype(np.float32)
    return factor
