"""A source that beats or jumps: no effect of the list, but its values over the states follow one wave, or one jump."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import ONE_WAVE
from processing.instrument.effects.base import SourceEffect, ValuePerState

#: Frequencies of a wave over n states, for each state; and between two of them, where a wave is looked at closely.
FREQUENCIES, CLOSELY = 8, 9


def waves(cycles: Array, n: int) -> Array:
    """Cosine and sine over n states of each frequency (F,) in cycles a state, (F, n, 2)."""
    turns = 2 * np.pi * np.outer(cycles, np.arange(n))
    return np.stack([np.cos(turns), np.sin(turns)], axis=2)


def jumps(n: int) -> Iterator[Array]:
    """A jump beside a drift, (n, 3), at every state."""
    k = np.arange(n)
    drift = np.stack([k / n, (k / n) ** 2], axis=1)
    drift -= drift.mean(axis=0)
    for first in range(2, n - 1):
        yield np.column_stack([(k >= first) - 1 + first / n, drift])


def beat_explains_more(found: Posterior, cause: Cause) -> bool:
    """Whether in a cause's place a source that follows one wave, in each of its captures, fits better.

    What a turning plate passes is a wave over the states too, of once or twice a turn; a beat has a frequency of its
    own. Values for each state that take part are asked themselves (`patterned`).
    """
    sets, best = found.sets, found.samples.best
    labels = [found.label(g) for g in range(len(found.members))]
    source = [
        g for g, c in enumerate(labels) if isinstance(c.effect, SourceEffect) and isinstance(c.effect, ValuePerState)
    ]
    if not source or np.any(best.tau[source] > 0):
        return False
    own = labels.index(cause.candidates[0])
    given = sets.given_others(sets.without(best, own))
    most = 0.0
    for g in source:
        curvature, gradient = given[g]
        last = 0
        for m in found.members[g]:
            part = slice(last, last := last + found.space.candidates[m].size)
            most += _best(curvature[part, part], gradient[part]) - 2 * ONE_WAVE
    return bool(most > _explained(*given[own]))


def _best(curvature: Array, gradient: Array) -> float:
    """Most chi-square that one wave of values with a curvature (N, N) and a gradient (N,) explains."""

    def explained(wave: Array) -> float:
        return _explained(wave.T @ curvature @ wave, wave.T @ gradient)

    cycles, step = _cycles(gradient.size)
    near = cycles[int(np.argmax([explained(wave) for wave in waves(cycles, gradient.size)]))]
    closely = near + step * np.linspace(-1, 1, 2 * CLOSELY + 1)
    return max(explained(wave) for wave in waves(closely, gradient.size))


def _cycles(n: int) -> tuple[Array, float]:
    """Frequencies in cycles a state, and the step between two of them."""
    return np.linspace(0.5 / n, 0.5, FREQUENCIES * n, retstep=True)


def _explained(curvature: Array, gradient: Array) -> float:
    """Chi-square that values explain where nothing draws them to zero."""
    return float(gradient @ np.linalg.pinv(curvature, hermitian=True) @ gradient)


@dataclass(frozen=True)
class Patterned:
    """Chi-square that values explain, as far as one pattern holds it, beyond noise, and what noise alone explains."""

    held: float
    beyond_noise: float
    noise: float


def patterned(values: Array, information: Array, covariance: Array) -> Patterned:
    """What of values (N,) one sine over the states explains too, or a jump beside a drift.

    `information` (N, N) is the curvature of the chi-square: patterns that the unknown sample takes up do not count.
    `covariance` (N, N) is that of the values, which shrink to their prior, and their noise with them.
    """
    n = values.size
    power, vector = np.linalg.eigh(information)
    root = (vector * np.sqrt(np.maximum(power, 0.0))).T
    # All about their means: gains that all grow by one factor are taken up by the throughput, so that one constant for
    # all is seen as these values themselves, with the other sign, and would be a pattern of any values.
    seen = root @ (values - values.mean())
    kept = np.clip(np.linalg.eigvalsh(root @ covariance @ root.T), 0.0, 1.0)
    noise = float(kept @ kept)
    held = 0.0
    for pattern in (*waves(_cycles(n)[0], n), *jumps(n)):
        u, size, _ = np.linalg.svd(root @ pattern, full_matrices=False)
        along = u[:, size > 1e-6 * size[0]].T @ seen
        held = max(held, float(along @ along))
    return Patterned(held, float(seen @ seen) - noise, noise)
